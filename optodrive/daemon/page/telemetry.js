// The telemetry: server-sent events by fetch, for EventSource cannot send a header; taken up again whenever it ends.

import { request } from "./api.js";

const RETRY_MS = 500;
const SILENT_MS = 3000;

export class Telemetry extends EventTarget {
  #abort = null;
  #paused = false;

  constructor(rateHz) {
    super();
    this.rateHz = rateHz;
    this.live = false;
    // Browsers give all windows on one daemon six connections together: a hidden one must not hold any that STOP needs.
    document.addEventListener("visibilitychange", () => this.pause(document.hidden));
  }

  async run() {
    for (;;) {
      if (!this.#paused) {
        await this.#follow().catch(() => {});
        this.#down();
      }
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
  }

  pause(paused) {
    this.#paused = paused;
    if (paused) {
      this.#abort?.abort();
    }
  }

  async #follow() {
    this.#abort = new AbortController();
    let timer = setTimeout(() => this.#abort.abort(), SILENT_MS);
    try {
      const answer = await request("GET", `/v1/telemetry?rate_hz=${this.rateHz}`, { signal: this.#abort.signal });
      if (answer.status === 401) {
        this.dispatchEvent(new Event("stranger"));
      }
      if (!answer.ok) {
        return;
      }
      let rest = "";
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) {
          return;
        }
        clearTimeout(timer);
        timer = setTimeout(() => this.#abort.abort(), SILENT_MS);
        const parts = (rest + value).split("\n\n");
        rest = parts.pop();
        this.#take(parts);
      }
    } finally {
      clearTimeout(timer);
      this.#abort.abort();
    }
  }

  #take(parts) {
    if (!this.live) {
      this.live = true;
      this.dispatchEvent(new Event("up"));
    }
    for (const part of parts) {
      const [first, second] = part.split("\n");
      this.dispatchEvent(new CustomEvent(first.slice(7), { detail: JSON.parse(second.slice(6)) }));
    }
  }

  #down() {
    if (this.live) {
      this.live = false;
      this.dispatchEvent(new Event("down"));
    }
  }
}
