// Fingers and the page that stands: where they are, and the rate and height of the dots under each.

import { labelCap } from "./caps.js";
import { decodeUint16 } from "./grid.js";

const TRACKERS = {
  none: "No tracker reports fingers.",
  seen: "A tracker reports the fingers.",
  lost: "The tracker is lost.",
  unknown: "Unknown where fingers are: no data from the daemon.",
};
const TEXT_MS = 500;
const MEAN_MS = 1000; // the telemetry counts pulses over 0.2 s, in which one more or less is 5 per second
const STEADY_MS = 1000; // a tracker that comes and goes faster is not announced each time

export class FingersView {
  #tracker = "none";
  #said = "none";
  #sayTimer = null;
  #textDueMs = 0;
  #fingers = [];
  #recent = new Map(); // number of a finger → its figures of the last MEAN_MS

  constructor(find, view, pitchM, announce) {
    this.find = find;
    this.view = view;
    this.pitchM = pitchM;
    this.announce = announce;
    this.dots = 0;
    this.caps = [];
    this.touchedOnly = false;
  }

  // Show a page's outline of dots, none without a page, and the caps that take light from it.
  showPage({ height, limited_by, touched_only }) {
    this.caps = limited_by;
    this.touchedOnly = touched_only;
    const values = decodeUint16(height);
    this.view.page = values.length === this.view.grid.pixels ? values : new Uint16Array(this.view.grid.pixels);
    this.dots = this.view.page.reduce((sum, value) => sum + (value > 0), 0);
    this.view.redrawMarks();
    this.#describe();
  }

  showFingers({ tracker, fingers }) {
    const { grid } = this.view;
    this.view.fingers = fingers.map((finger) => ({
      label: String(finger.number),
      column: finger.x_m / this.pitchM + (grid.columns - 1) / 2,
      row: finger.y_m / this.pitchM + (grid.rows - 1) / 2,
      radius: finger.radius_m / this.pitchM,
    }));
    this.view.requestPaint();
    const now = performance.now();
    this.#fingers = fingers;
    this.#remember(fingers, now);
    if (!this.#follow(tracker) && now < this.#textDueMs) {
      return;
    }
    this.#textDueMs = now + TEXT_MS;
    this.#describe();
  }

  // Show nothing: where fingers are and what stands is unknown.
  clear() {
    const [event, page] = [{ tracker: "unknown", fingers: [] }, { height: "", limited_by: [], touched_only: false }];
    this.showFingers(event);
    this.showPage(page);
  }

  // Return whether the tracker's state is another one. It is said once, and the figures, which change all the time, are not.
  #follow(tracker) {
    if (tracker === this.#tracker) {
      return false;
    }
    this.#tracker = tracker;
    clearTimeout(this.#sayTimer);
    if (tracker !== this.#said && tracker !== "unknown") {
      this.#sayTimer = setTimeout(() => {
        this.#said = tracker;
        this.announce(this.#describeTracker());
      }, STEADY_MS);
    }
    return true;
  }

  #remember(fingers, now) {
    const touching = fingers.filter((finger) => finger.dots > 0);
    const kept = touching.map((finger) => {
      const before = (this.#recent.get(finger.number) ?? []).filter(({ at }) => at > now - MEAN_MS);
      return [finger.number, [...before, { at: now, rateHz: finger.rate_hz, share: finger.height_share }]];
    });
    this.#recent = new Map(kept);
  }

  #buildLine(finger) {
    const line = document.createElement("li");
    const dots = `${finger.dots} ${finger.dots === 1 ? "dot" : "dots"}`;
    const recent = this.#recent.get(finger.number) ?? [];
    const mean = (name) => recent.reduce((sum, each) => sum + each[name], 0) / recent.length;
    line.textContent = finger.dots && this.dots
      ? `Finger ${finger.number}: ${dots}, ${mean("rateHz").toFixed(0)} pulses/s each, ${(100 * mean("share")).toFixed(0)} % of the height`
      : `Finger ${finger.number}: no dots of the page`;
    return line;
  }

  #describeTracker() {
    const isAllDrawn = this.#tracker === "lost" && this.dots > 0;
    const lost = this.touchedOnly ? "all dots are dark" : "the whole page is drawn in turn";
    return isAllDrawn ? `The tracker is lost: ${lost}.` : TRACKERS[this.#tracker];
  }

  // All texts at once, so that none is older than another.
  #describe() {
    this.find("fingers").replaceChildren(...this.#fingers.map((finger) => this.#buildLine(finger)));
    const isUsed = !["none", "unknown"].includes(this.#tracker) || this.dots > 0;
    this.find("fingers-panel").hidden &&= !isUsed; // once shown it stays, so that nothing moves
    const caps = this.caps.map((cap) => ` The cap “${labelCap(cap)}” takes light from it.`);
    const dark = this.touchedOnly ? " Dots that no finger touches are dark." : "";
    const page = this.dots ? `A page of ${this.dots} ${this.dots === 1 ? "dot" : "dots"} stands.${dark}${caps.join("")}` : "No page stands.";
    this.find("standing").textContent = this.#tracker === "unknown" ? "" : page;
    this.find("tracker").textContent = this.#describeTracker();
  }
}
