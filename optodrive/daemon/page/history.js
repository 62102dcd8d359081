// History of faults and plans since the page was opened in this tab; a reload keeps it.

import { describeStatus } from "./plan_end.js";

const FAULTS_MAX = 50;
const PLANS_MAX = 50;
const LEAVING_MS = 5000; // a page that is left or reloaded ends its own connection
const STORE = "history";
const TIME = new Intl.DateTimeFormat(undefined, { timeStyle: "medium", hourCycle: "h23" });
export const FRAME_NAME = /^frame \d+$/; // of a streamed frame, as the daemon names its plan

export class History {
  constructor(find) {
    this.lists = { faults: find("fault-history"), plans: find("plan-history") };
    this.entries = { faults: [], plans: [] };
    this.planned = 0;
    this.leftAt = -Infinity;
    this.isFirstFault = true;
    addEventListener("beforeunload", () => (this.leftAt = performance.now()));
    this.#restore();
    this.#show("faults");
    this.#show("plans");
  }

  // Note a connection to the daemon: the fault that it reports first may have begun at any time before.
  begin() {
    this.isFirstFault = true;
  }

  addFault(fault) {
    const isEarlier = this.isFirstFault;
    this.isFirstFault = false;
    if (fault.link === "down") {
      this.#addFault("bad", `No link to the board${fault.link_error ? `: ${fault.link_error}` : ""}`, isEarlier);
    } else if (fault.fault) {
      this.#addFault("bad", `${fault.fault}: ${fault.hint}`, isEarlier);
    } else if (this.entries.faults[0]?.kind === "bad") {
      this.#addFault("good", "No fault, the link is up", isEarlier);
    }
  }

  addNoDaemon() {
    if (performance.now() - this.leftAt > LEAVING_MS) {
      this.#addFault("bad", "The daemon does not answer");
    }
  }

  showPlans({ queue, totals }) {
    if (totals.planned < this.planned) {
      this.entries.plans.forEach((entry) => (entry.plan = null)); // a restarted daemon numbers its plans anew
    }
    this.planned = totals.planned;
    let changed = false;
    for (const plan of queue.plans) {
      changed = this.#updatePlan(plan) || changed;
    }
    if (changed) {
      this.#show("plans");
    }
  }

  #updatePlan(plan) {
    const isFrame = FRAME_NAME.test(plan.name);
    const [newest] = this.entries.plans;
    let entry = this.entries.plans.find((each) => each.plan === plan.plan);
    if (!entry && isFrame && newest?.stream === plan.caller) {
      entry = newest; // one entry for the frames of a stream
    }
    if (!entry) {
      entry = { at: Date.now() - 1000 * plan.age_s, kind: "", text: "", plan: plan.plan, stream: isFrame ? plan.caller : null };
      this.entries.plans.unshift(entry);
      this.entries.plans.splice(PLANS_MAX);
    } else if (entry.stream !== null && Number(plan.plan.slice(1)) < Number(entry.plan.slice(1))) {
      return false; // an earlier frame of the stream
    }
    const by = plan.caller ? ` by ${plan.caller}` : "";
    const status = describeStatus(plan);
    const text = `${plan.plan} ${plan.name}${by}: ${status.text}, ${plan.executed} of ${plan.planned} pulses`;
    const changed = entry.text !== text;
    Object.assign(entry, { plan: plan.plan, text, kind: status.kind });
    return changed;
  }

  #addFault(kind, text, isEarlier = false) {
    if (this.entries.faults[0]?.text !== text) {
      this.entries.faults.unshift({ at: Date.now(), isEarlier, kind, text });
      this.entries.faults.splice(FAULTS_MAX);
      this.#show("faults");
    }
  }

  #show(name) {
    const rows = this.entries[name].map(({ at, isEarlier, kind, text }) => {
      const row = Object.assign(document.createElement("li"), { className: kind });
      row.append(Object.assign(document.createElement("time"), { textContent: `${isEarlier ? "before " : ""}${TIME.format(at)}` }), ` ${text}`);
      return row;
    });
    this.lists[name].replaceChildren(...(rows.length ? rows : [Object.assign(document.createElement("li"), { textContent: "None." })]));
    try {
      sessionStorage.setItem(STORE, JSON.stringify({ ...this.entries, planned: this.planned }));
    } catch {
      // The browser keeps nothing: a reload starts with an empty history.
    }
  }

  #restore() {
    try {
      const { faults, plans, planned } = JSON.parse(sessionStorage.getItem(STORE));
      this.entries = { faults, plans };
      this.planned = planned;
    } catch {
      // Nothing is kept yet.
    }
  }
}
