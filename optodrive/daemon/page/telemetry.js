// Telemetry: server-sent events read by fetch, because EventSource cannot send a header; it reconnects after every end.

import { request } from "./api.js";

const RETRY_MS = 500;
const REFUSED_RETRY_MS = 5000; // the daemon notes every request with an invalid token
const SILENCE_MS = 3000;

export class Telemetry extends EventTarget {
  #abort = null;
  #paused = false;

  constructor(rateHz) {
    super();
    this.rateHz = rateHz;
    this.live = false;
    this.isRefused = false; // whether the daemon does not know the token
    this.revocation = ""; // why the token is revoked, as the daemon says it
    // Browsers allow six connections per daemon for all windows: a hidden window must not hold one that STOP needs.
    document.addEventListener("visibilitychange", () => this.pause(document.hidden));
  }

  get paused() {
    return this.#paused;
  }

  async run() {
    for (;;) {
      if (!this.#paused) {
        await this.#readEvents().catch(() => {});
        this.#setDown();
      }
      await new Promise((resolve) => setTimeout(resolve, this.isRefused ? REFUSED_RETRY_MS : RETRY_MS));
    }
  }

  pause(paused) {
    this.#paused = paused;
    if (paused) {
      this.#abort?.abort();
    }
  }

  async #readEvents() {
    this.#abort = new AbortController();
    let timer = setTimeout(() => this.#abort.abort(), SILENCE_MS);
    try {
      const response = await request("GET", `/v1/telemetry?rate_hz=${this.rateHz}`, { signal: this.#abort.signal });
      this.isRefused = response.status === 401;
      if (this.isRefused) {
        this.dispatchEvent(new Event("unauthorized"));
      }
      if (!response.ok) {
        return;
      }
      let rest = "";
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      for (;;) {
        const { value, done } = await reader.read();
        if (done) {
          return;
        }
        clearTimeout(timer);
        timer = setTimeout(() => this.#abort.abort(), SILENCE_MS);
        const texts = (rest + value).split("\n\n");
        rest = texts.pop();
        this.#dispatch(texts);
      }
    } finally {
      clearTimeout(timer);
      this.#abort.abort();
    }
  }

  #dispatch(texts) {
    if (!this.live) {
      this.live = true;
      this.revocation = "";
      this.dispatchEvent(new Event("up"));
    }
    for (const text of texts) {
      if (text.startsWith(": ")) {
        this.revocation = text.slice(2); // the only line of its kind, and the last one
        continue;
      }
      const [event, data] = text.split("\n");
      this.dispatchEvent(new CustomEvent(event.slice("event: ".length), { detail: JSON.parse(data.slice("data: ".length)) }));
    }
  }

  #setDown() {
    if (this.live) {
      this.live = false;
      this.dispatchEvent(new Event("down"));
    }
  }
}
