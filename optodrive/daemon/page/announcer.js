// What a screen reader says by itself: each text is an element of its own, so that two in a row are both said.

const KEPT = 5; // the newest ones; a reader that has not said an older one by then would be late

export class Announcer {
  // region: a live region, whose additions screen readers say
  constructor(region) {
    this.region = region;
  }

  say(text) {
    if (text) {
      this.region.append(Object.assign(document.createElement("p"), { textContent: text }));
      while (this.region.childElementCount > KEPT) {
        this.region.firstElementChild.remove();
      }
    }
  }
}

const PACE_MS = 3000; // about the time in which a sentence is heard

// Reports that nobody asked for: the first at once, then one every few seconds, of each topic the newest.
export class Reports {
  #waiting = new Map(); // topic → text, and whether it is an alert
  #saidAt = { alert: -Infinity, any: -Infinity };
  #timer = null;

  // alerts: announcer that interrupts; routine: announcer that does not
  constructor(alerts, routine) {
    this.alerts = alerts;
    this.routine = routine;
  }

  // Say a text in its turn; "" withdraws what waits on its topic. An alert waits for other alerts only.
  report(topic, text, isAlert = false) {
    this.#waiting.delete(topic);
    if (text) {
      this.#waiting.set(topic, { text, isAlert });
    }
    this.#sayDue();
  }

  #sayDue() {
    clearTimeout(this.#timer);
    const entries = [...this.#waiting];
    const [topic, first] = entries.find(([name]) => name === "stop") ?? entries.find(([, each]) => each.isAlert) ?? entries[0] ?? [];
    if (!first) {
      return;
    }
    const leftMs = this.#saidAt[first.isAlert ? "alert" : "any"] + PACE_MS - performance.now();
    if (leftMs > 0) {
      this.#timer = setTimeout(() => this.#sayDue(), leftMs);
      return;
    }
    this.#waiting.delete(topic);
    this.#saidAt.any = performance.now();
    if (first.isAlert) {
      this.#saidAt.alert = performance.now();
    }
    (first.isAlert ? this.alerts : this.routine).say(first.text);
    this.#sayDue();
  }
}
