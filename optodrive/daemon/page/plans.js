// Preview and play: a stimulus is planned without light first, and only a previewed stimulus can be played.

import { call } from "./api.js";
import { labelCap } from "./caps.js";
import { describeStatus } from "./plan_end.js";
import { formatQuantity } from "./quantities.js";

const POLL_MS = 400;
const FRAMES_MAX = 500;
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
  constructor(find, buildRequest, announce) {
    super();
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
    for (const delay of summary.delays.slice(0, 3)) {
      lines.push(["warn", `${delay.source} is delayed by ${delay.wait_s.toFixed(2)} s: ${labelCap(delay.cap)}.`]);
    }
    if (summary.skipped.length) {
      lines.push(["", `${summary.skipped.length} pixels need no pulse: their residual heat is sufficient.`]);
    }
    this.#showLines(...lines);
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
      this.announce(`Playing ${plan.plan}`);
      this.dispatchEvent(new Event("played"));
      await this.#follow(plan);
    } catch (error) {
      this.#showError(error);
    }
    setEnabled(this.playButton, this.previewed !== null);
  }

  // Show the result once the plan has ended. The panel Playing shows its progress.
  async #follow(plan) {
    this.followed = plan.plan;
    this.#showLines(["", `${plan.plan} plays.`]);
    while (!FINAL_STATUSES.includes(plan.status)) {
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      plan = await call("GET", `/v1/plans/${plan.plan}?pulses=false`);
      if (this.followed !== plan.plan) {
        return;
      }
    }
    const height = plan.simulated_max_um === null ? "" : `; highest ${plan.simulated_max_um.toFixed(1)} µm, simulated from the executed pulses`;
    const { text, kind } = describeStatus(plan);
    this.#showLines([kind, `${plan.plan} ${text}.`], ["", `${plan.executed} of ${plan.planned} pulses executed${height}.`]);
  }

  #showError(error) {
    if (error.name === "AbortError") {
      this.#showLines(["soft", "Cancelled."]);
      return;
    }
    const where = error.problem?.where ? `${error.problem.where}: ` : "";
    this.#showLines(["bad", error.message.startsWith(where) ? error.message : where + error.message]);
  }

  #showLines(...lines) {
    this.result.replaceChildren(
      ...lines.map(([kind, text]) => Object.assign(document.createElement("p"), { className: kind, textContent: text })),
    );
  }
}
