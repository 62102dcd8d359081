// Preview and play: what is asked for is planned without light first, and only what was previewed can be played.

import { call } from "./api.js";

const POLL_MS = 400;
const FRAMES_MAX = 500;
const ENDED = ["done", "superseded", "failed", "cancelled"];

// Labels by cap, from the configuration.
export const CAPS = {};

export function setCaps(caps) {
  for (const [key, { label }] of Object.entries(caps)) {
    CAPS[key] = label;
  }
}

// Frames of a drawing, once or so often a second.
export function framesOf(heights, rateHz, seconds) {
  const target_um = {};
  heights.forEach((height, pixel) => {
    if (height > 0) {
      target_um[pixel] = Math.round(height * 10) / 10;
    }
  });
  const count = rateHz > 0 ? Math.max(1, Math.min(FRAMES_MAX, Math.round(rateHz * seconds))) : 1;
  const duration_s = rateHz > 0 ? 1 / rateHz : seconds;
  const frames = Array.from({ length: count }, (_, k) => ({ id: `drawn-${k}`, show_at_s: k * duration_s, duration_s, target_um }));
  return { frames };
}

export class Plans extends EventTarget {
  // request(): path without ?, and body, of what is asked for now
  constructor(find, request, say) {
    super();
    this.request = request;
    this.say = say;
    this.preview = find("preview");
    this.play = find("play");
    this.policy = find("policy");
    this.result = find("result");
    this.ready = null;
    this.abort = null;
    this.preview.addEventListener("click", () => this.#preview());
    this.play.addEventListener("click", () => this.#play());
    this.policy.addEventListener("change", () => this.changed());
  }

  // What was previewed is no longer what is asked for.
  changed() {
    this.ready = null;
    this.play.disabled = true;
    this.dispatchEvent(new CustomEvent("previewed", { detail: null }));
  }

  // Give up connections that wait for an answer.
  cancel() {
    this.abort?.abort();
  }

  async #preview() {
    this.changed();
    this.followed = null;
    this.abort = new AbortController();
    this.#tell(["soft", "Planning …"]);
    this.preview.disabled = true;
    try {
      const ready = { ...(await this.request()), policy: this.policy.value };
      const query = `?dry_run=true&policy=${ready.policy}`;
      const answer = await call("POST", ready.path + query, { body: ready.body, signal: this.abort.signal });
      this.ready = ready;
      this.play.disabled = false;
      this.#show(answer);
      this.dispatchEvent(new CustomEvent("previewed", { detail: answer.pulses }));
    } catch (error) {
      this.#failed(error);
    } finally {
      this.preview.disabled = false;
    }
  }

  #show(answer) {
    const { summary } = answer;
    const lines = [];
    const fits = summary.feasibility?.fits ?? summary.trimmed.pulses === 0;
    const message = summary.feasibility?.message ?? (fits ? "all of it fits" : "not all of it fits");
    lines.push([fits ? "good" : "warn", `${message[0].toUpperCase()}${message.slice(1)}.`]);
    lines.push(["", `${summary.pulses} pulses in ${summary.duration_s.toFixed(2)} s, ${(summary.energy_j * 1e3).toFixed(0)} mJ of light.`]);
    lines.push(["", `Highest predicted: ${summary.predicted_max_um.toFixed(1)} µm of ${summary.target_max_um.toFixed(1)} µm requested.`]);
    if (summary.trimmed.pulses) {
      const caps = Object.entries(summary.trimmed.by_reason).map(([cap, count]) => `${count} for ${CAPS[cap] ?? cap}`);
      lines.push(["warn", `Trimmed: ${summary.trimmed.pulses} pulses (${caps.join(", ")}), ${(summary.trimmed.energy_j * 1e3).toFixed(1)} mJ.`]);
    }
    for (const delay of summary.delays.slice(0, 3)) {
      lines.push(["warn", `${delay.source} comes ${delay.wait_s.toFixed(2)} s later for ${CAPS[delay.cap] ?? delay.cap}.`]);
    }
    if (summary.skipped.length) {
      lines.push(["", `${summary.skipped.length} pixels need no pulse: the heat left in them is enough.`]);
    }
    this.#tell(...lines);
  }

  async #play() {
    const ready = this.ready;
    this.play.disabled = true; // a second press would play it twice
    try {
      const answer = await call("POST", `${ready.path}?policy=${ready.policy}`, { body: ready.body });
      this.say(`Playing ${answer.plan}`);
      await this.#follow(answer);
    } catch (error) {
      this.#failed(error);
    }
    this.play.disabled = this.ready === null;
  }

  async #follow(answer) {
    const bar = document.createElement("progress");
    bar.max = Math.max(1, answer.planned);
    bar.setAttribute("aria-label", "Pulses executed");
    this.followed = answer.plan;
    while (!ENDED.includes(answer.status)) {
      this.#tell(["", `${answer.plan}: ${answer.executed} of ${answer.planned} pulses executed`]);
      bar.value = answer.executed;
      this.result.append(bar);
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      answer = await call("GET", `/v1/plans/${answer.plan}?pulses=false`);
      if (this.followed !== answer.plan) {
        return;
      }
    }
    const height = answer.simulated_max_um === null ? "" : `; highest ${answer.simulated_max_um.toFixed(1)} µm by what was executed`;
    const why = answer.error ? `: ${answer.error}` : "";
    this.#tell([answer.status === "done" ? "good" : "warn", `${answer.plan} ${answer.status}${why}`], ["", `${answer.executed} of ${answer.planned} pulses executed${height}.`]);
  }

  #failed(error) {
    if (error.name === "AbortError") {
      this.#tell(["soft", "Given up."]);
      return;
    }
    const where = error.problem?.where ? `${error.problem.where}: ` : "";
    this.#tell(["bad", error.message.startsWith(where) ? error.message : where + error.message]);
  }

  #tell(...lines) {
    this.result.replaceChildren(
      ...lines.map(([kind, text]) => Object.assign(document.createElement("p"), { className: kind, textContent: text })),
    );
  }
}
