// Fingers and the page that stands: where they are, and the rate and height of the dots under each.

import { decodeUint16 } from "./grid.js";

const TRACKERS = {
  none: "No tracker reports fingers.",
  seen: "A tracker reports the fingers.",
  lost: "The tracker is lost: the whole page is drawn in turn.",
};
const TEXT_MS = 500;

export class FingersView {
  #tracker = "none";
  #textDueMs = 0;

  constructor(find, view, pitchM, announce) {
    this.find = find;
    this.view = view;
    this.pitchM = pitchM;
    this.announce = announce;
    this.dots = 0;
  }

  // Show a page's outline of dots, none without a page.
  showPage({ height }) {
    const values = decodeUint16(height);
    this.view.page = values.length === this.view.grid.pixels ? values : new Uint16Array(this.view.grid.pixels);
    this.dots = this.view.page.reduce((sum, value) => sum + (value > 0), 0);
    this.view.redrawMarks();
    this.#describePage();
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
    if (tracker !== this.#tracker) {
      this.announce(TRACKERS[tracker]); // said once; the figures change all the time and are not
    }
    const now = performance.now();
    if (tracker === this.#tracker && now < this.#textDueMs) {
      return;
    }
    this.#tracker = tracker;
    this.#textDueMs = now + TEXT_MS;
    this.#describePage();
    this.find("fingers").replaceChildren(...fingers.map((finger) => this.#buildLine(finger)));
  }

  #buildLine(finger) {
    const line = document.createElement("li");
    const dots = `${finger.dots} ${finger.dots === 1 ? "dot" : "dots"}`;
    line.textContent = finger.dots
      ? `Finger ${finger.number}: ${dots}, ${finger.rate_hz.toFixed(0)} pulses/s each, ${(100 * finger.height_share).toFixed(0)} % of their height`
      : `Finger ${finger.number}: no dots of the page`;
    return line;
  }

  #describePage() {
    const isUsed = this.#tracker !== "none" || this.dots > 0;
    this.find("fingers-panel").hidden &&= !isUsed; // once shown it stays, so that nothing moves
    this.find("standing").textContent = this.dots ? `A page of ${this.dots} dots stands.` : "No page stands.";
    this.find("tracker").textContent = TRACKERS[this.#tracker];
  }
}
