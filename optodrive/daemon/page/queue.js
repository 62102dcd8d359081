// What plays, by whom and for how much longer, and what waits for the beam.

import { call } from "./api.js";
import { FRAME_NAME } from "./history.js";

const TICK_MS = 200;

export class QueueView {
  constructor(find, announce, onError) {
    this.title = find("playing-title");
    this.idle = find("idle");
    this.now = find("now");
    this.end = find("end");
    this.list = find("queue");
    this.announce = announce;
    this.onError = onError;
    this.rows = new Map();
    this.running = null;
    this.clear();
    this.end.addEventListener("click", () => this.#cancel(this.running));
    setInterval(() => this.#showTimeLeft(), TICK_MS);
  }

  // Show nothing: what plays is unknown.
  clear(text = "") {
    this.#showWhether(null);
    this.idle.textContent = text;
    this.#showWaiting([]);
  }

  // light: "off" while the board is not armed, "emits" while it says that it emits, "may" otherwise
  show(queue, light) {
    const [first, ...others] = light === "off" ? [] : queue.active; // what is still listed has ended
    const isRunning = first !== undefined && (first.plan === queue.running || isFrame(first));
    const nothing = light === "emits" ? "Not reported yet: what plays." : "Nothing plays.";
    this.idle.textContent = first ? "The next plan starts." : nothing;
    this.#showWhether(isRunning ? first : null);
    this.at = performance.now();
    if (isRunning) {
      this.#showRunning(first);
    }
    const waiting = isRunning ? others : [first, ...others].filter(Boolean);
    this.#showWaiting(waiting.filter((plan) => !isFrame(plan))); // the next frame replaces one that waits
  }

  // Show whether a plan runs; null: none does.
  #showWhether(plan) {
    this.running = plan;
    this.idle.hidden = plan !== null;
    this.now.toggleAttribute("data-empty", plan === null);
    for (const element of [this.end, this.now.querySelector("progress")]) {
      element.toggleAttribute("data-empty", plan === null || isFrame(plan)); // the next frame would follow
    }
  }

  #showRunning(plan) {
    const { now } = this;
    const name = now.querySelector(".plan");
    name.textContent = name.title = describe(plan);
    const bar = now.querySelector("progress");
    bar.max = Math.max(1, plan.planned);
    bar.value = plan.executed;
    this.end.setAttribute("aria-label", `End ${describe(plan)}`);
    this.#showTimeLeft();
  }

  #showTimeLeft() {
    const plan = this.running;
    if (plan && isFrame(plan)) {
      this.now.querySelector(".left").textContent = "STOP ends them.";
    } else if (plan) {
      const leftS = Math.max(0, plan.ends_in_s - (performance.now() - this.at) / 1000);
      const left = plan.ends_in_s === null ? "paused" : `${leftS.toFixed(1)} s left`;
      this.now.querySelector(".left").textContent = `${plan.executed} of ${plan.planned} pulses, ${left}`;
    }
  }

  // Waiting plans never change their order. Rows are kept, so that the focus stays on their button.
  #showWaiting(plans) {
    const waiting = new Set(plans.map((plan) => plan.plan));
    for (const [id, row] of this.rows) {
      if (!waiting.has(id)) {
        const hadFocus = row.contains(document.activeElement);
        row.remove();
        this.rows.delete(id);
        if (hadFocus) {
          (this.list.querySelector("button") ?? this.title).focus();
        }
      }
    }
    for (const plan of plans) {
      const row = this.rows.get(plan.plan) ?? this.#createRow(plan);
      row.querySelector(".soft").textContent = `${plan.duration_s.toFixed(1)} s, starts in ${Math.max(0, plan.starts_in_s).toFixed(0)} s`;
    }
    this.list.hidden = plans.length === 0;
  }

  #createRow(plan) {
    const row = document.createElement("li");
    const text = Object.assign(document.createElement("span"), { className: "plan", textContent: describe(plan) });
    const times = Object.assign(document.createElement("span"), { className: "soft" });
    const button = Object.assign(document.createElement("button"), { type: "button", className: "quiet", textContent: "Cancel" });
    button.setAttribute("aria-label", `Cancel ${describe(plan)}`);
    button.addEventListener("click", () => this.#cancel(plan));
    row.append(text, times, button);
    this.list.append(row);
    this.rows.set(plan.plan, row);
    return row;
  }

  async #cancel(plan) {
    if (plan) {
      await call("DELETE", `/v1/plans/${plan.plan}`).then(() => this.announce(`${plan.plan} is cancelled.`), this.onError);
    }
  }
}

function isFrame(plan) {
  return FRAME_NAME.test(plan.name);
}

// Streamed frames replace each other too fast to be told apart.
function describe(plan) {
  const what = isFrame(plan) ? "Streamed frames" : `${plan.plan} ${plan.name}`;
  return `${what}${plan.caller ? ` by ${plan.caller}` : ""}`;
}
