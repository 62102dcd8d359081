// Preview and play: a stimulus is planned without light first, and only a previewed stimulus can be played.

import { call } from "./api.js";
import { labelCap } from "./caps.js";
import { describeStatus } from "./plan_end.js";
import { formatQuantity } from "./quantities.js";

const FRAMES_MAX = 500;
const VERBS = { planned: "waits", queued: "waits", running: "plays", paused: "is paused" };
const FINAL_STATUSES = ["done", "superseded", "stopped", "failed", "cancelled"];

// Quantities that a drawing may state, by their keys in a frame: name, unit, decimals, default and bounds.
export const TARGETS = {
  target_um: { label: "Height, µm", unit: " µm", decimals: 1, value: 100, min: 1, max: 1000 },
  intensity: { label: "Intensity", unit: " thresholds", decimals: 2, value: 8, min: 0.1, max: 100 },
};

// Build the frames of a drawing: one, or several at a rate.
// key: of TARGETS; values: of each pixel, 0 where nothing is drawn
export function buildFrames(key, values, rateHz, seconds) {
  const target = {};
  values.forEach((value, pixel) => {
    if (value > 0) {
      target[pixel] = Number(value.toFixed(TARGETS[key].decimals));
    }
  });
  const count = rateHz > 0 ? Math.max(1, Math.min(FRAMES_MAX, Math.round(rateHz * seconds))) : 1;
  const duration_s = rateHz > 0 ? 1 / rateHz : seconds;
  const frames = Array.from({ length: count }, (_, k) => ({ id: `drawn-${k}`, show_at_s: k * duration_s, duration_s, [key]: target }));
  return { frames };
}

// A button that is disabled loses the focus; these keep it and do nothing.
const setEnabled = (button, enabled) => button.setAttribute("aria-disabled", !enabled);
const isEnabled = (button) => button.getAttribute("aria-disabled") !== "true";

const readPolicy = () => document.querySelector('input[name="policy"]:checked').value;

export class PlanControl extends EventTarget {
  // buildRequest(): returns path and body of the present stimulus
  // announce(text): says the answer to what was pressed; report(text): says how a plan ended
  constructor(find, buildRequest, announce, report) {
    super();
    this.report = report;
    this.followed = null; // the plan that was played here, until its end
    this.buildRequest = buildRequest;
    this.announce = announce;
    this.previewButton = find("preview");
    this.playButton = find("play");
    this.result = find("result");
    this.previewed = null;
    this.abort = null;
    this.previewButton.addEventListener("click", () => isEnabled(this.previewButton) && this.#preview());
    this.playButton.addEventListener("click", () => isEnabled(this.playButton) && this.#play());
    for (const radio of document.querySelectorAll('input[name="policy"]')) {
      radio.addEventListener("change", () => this.invalidate());
    }
  }

  // Discard the preview: the stimulus has changed.
  invalidate() {
    this.previewed = null;
    setEnabled(this.playButton, false);
    this.dispatchEvent(new CustomEvent("previewed", { detail: null }));
  }

  // Abort a preview that waits for its response.
  cancel() {
    this.abort?.abort();
  }

  async #preview() {
    this.invalidate();
    this.followed = null;
    this.abort = new AbortController();
    this.#showLines(["soft", "Planning …"]);
    setEnabled(this.previewButton, false);
    try {
      const stimulus = { ...(await this.buildRequest()), policy: readPolicy() };
      const query = new URLSearchParams({ ...stimulus.query, policy: stimulus.policy, dry_run: true });
      const plan = await call("POST", `${stimulus.path}?${query}`, { body: stimulus.body, signal: this.abort.signal });
      this.previewed = stimulus;
      setEnabled(this.playButton, true);
      this.#showSummary(plan);
      this.result.scrollIntoView({ block: "nearest" }); // in a low window it is below the fold
      this.dispatchEvent(new CustomEvent("previewed", { detail: plan.pulses }));
    } catch (error) {
      this.#showError(error);
    } finally {
      setEnabled(this.previewButton, true);
    }
  }

  #showSummary(plan) {
    const { summary } = plan;
    const lines = [];
    const fits = summary.feasibility?.fits ?? summary.trimmed.pulses === 0;
    const message = summary.feasibility?.message ?? (fits ? "all of it fits" : "not all of it fits");
    lines.push([fits ? "good" : "warn", `${message[0].toUpperCase()}${message.slice(1)}.`]);
    lines.push(["", `${summary.pulses} pulses in ${summary.duration_s.toFixed(2)} s, ${formatQuantity(summary.energy_j, "J")} of light.`]);
    const requested = summary.target_max_um > 0 ? ` of ${summary.target_max_um.toFixed(1)} µm requested` : ""; // a train requests power
    lines.push(["", `Highest predicted: ${summary.predicted_max_um.toFixed(1)} µm${requested}.`]);
    if (summary.trimmed.pulses) {
      const caps = Object.entries(summary.trimmed.by_reason).map(([cap, count]) => `${count} by ${labelCap(cap)}`);
      lines.push(["warn", `Trimmed: ${summary.trimmed.pulses} pulses (${caps.join(", ")}), ${formatQuantity(summary.trimmed.energy_j, "J")}.`]);
    }
    const { count, trains } = summary.off_target;
    for (const train of trains.slice(0, 3)) {
      lines.push(["warn", `${train.message}.`]);
    }
    if (count > 3) {
      lines.push(["warn", `And peaks of ${count - 3} more ${count === 4 ? "train" : "trains"} differ.`]);
    }
    if (summary.repeats?.message) {
      lines.push(["warn", `${summary.repeats.message}.`]);
    }
    for (const delay of summary.delays.slice(0, 3)) {
      lines.push(["warn", `${delay.source} is delayed by ${delay.wait_s.toFixed(2)} s: ${labelCap(delay.cap)}.`]);
    }
    if (summary.skipped.length) {
      // A pixel may need none for some frames, and pulses for the others.
      const [targets, pixels] = [summary.skipped.length, new Set(summary.skipped.map(({ pixel }) => pixel)).size];
      const where = `${targets} ${targets === 1 ? "target" : "targets"} on ${pixels} ${pixels === 1 ? "pixel" : "pixels"}`;
      lines.push(["", `${where} ${targets === 1 ? "needs" : "need"} no pulse: the heat left there is sufficient.`]);
    }
    this.#showLines(...lines);
    this.announce(lines.map(([, text]) => text).join(" "));
  }

  // Play what was previewed, if anything was; also while the end of what it has played before is not known yet.
  playPreviewed() {
    if (this.previewed) {
      this.#play();
    }
  }

  async #play() {
    const stimulus = this.previewed;
    setEnabled(this.playButton, false); // a second click would play it twice
    try {
      const query = new URLSearchParams({ ...stimulus.query, policy: stimulus.policy });
      const plan = await call("POST", `${stimulus.path}?${query}`, { body: stimulus.body });
      this.announce(`Sent: ${plan.plan}`);
      this.dispatchEvent(new Event("played"));
      this.followed = plan.plan;
      this.#showLines(["", `${plan.plan} waits.`]);
    } catch (error) {
      this.#showError(error);
      setEnabled(this.playButton, this.previewed !== null);
    }
  }

  // Show how the plan goes that was played here. queue: as the daemon reports it, null if it is unknown
  async showQueue(queue) {
    const { followed } = this;
    if (followed === null) {
      return;
    }
    if (queue === null) {
      this.#showLines(["soft", `Unknown: how ${followed} goes on.`]);
      return;
    }
    const reported = [...queue.active, ...queue.plans].find(({ plan }) => plan === followed);
    if (reported && !FINAL_STATUSES.includes(reported.status)) {
      this.#showLines(["", `${followed} ${VERBS[reported.status]}.`]);
      return;
    }
    try {
      const plan = await call("GET", `/v1/plans/${followed}?pulses=false`);
      if (this.followed === followed && FINAL_STATUSES.includes(plan.status)) {
        this.followed = null;
        this.#showEnd(plan);
      }
    } catch (error) {
      if (error.status && this.followed === followed) {
        this.followed = null; // a restarted daemon does not know it
        this.#showError(error);
      }
    }
    setEnabled(this.playButton, this.followed === null && this.previewed !== null);
  }

  #showEnd(plan) {
    const height = plan.simulated_max_um === null ? "" : `; highest ${plan.simulated_max_um.toFixed(1)} µm, simulated from the executed pulses`;
    const { text, kind } = describeStatus(plan);
    this.#showLines([kind, `${plan.plan} ${text}.`], ["", `${plan.executed} of ${plan.planned} pulses executed${height}.`]);
    this.report(`${plan.plan} ${text}. ${plan.executed} of ${plan.planned} pulses executed${height}.`);
  }

  #showError(error) {
    if (error.name === "AbortError") {
      this.#showLines(["soft", "Cancelled."]);
      return;
    }
    const where = error.problem?.where ? `${error.problem.where}: ` : "";
    const text = error.message.startsWith(where) ? error.message : where + error.message;
    this.#showLines(["bad", text]);
    this.announce(text);
  }

  #showLines(...lines) {
    this.result.replaceChildren(
      ...lines.map(([kind, text]) => Object.assign(document.createElement("p"), { className: kind, textContent: text })),
    );
  }
}
