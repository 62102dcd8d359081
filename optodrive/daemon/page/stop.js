// STOP: sent at once and again until the daemon has answered, whatever else on this page works or does not.

import { request } from "./api.js";

const TRY_MS = 1200;
const AGAIN_MS = 300;

export class Stop {
  // beforeRetry: frees connections that may be in the way; after: the board's answer is in
  constructor(button, line, beforeRetry, after) {
    this.line = line;
    this.beforeRetry = beforeRetry;
    this.after = after;
    this.running = false;
    button.addEventListener("click", () => this.press());
    // Seen before anything on the page can take the key for itself.
    window.addEventListener("keydown", (event) => event.key === "Escape" && this.press(), { capture: true });
  }

  async press() {
    if (this.running) {
      return;
    }
    this.running = true;
    this.#say("STOP sent …");
    for (let tries = 1; ; tries++) {
      if (await this.#try(tries)) {
        break;
      }
      this.#say(`STOP is not answered yet, sent ${tries} times and again. In doubt use the emergency stop or the key.`);
      this.beforeRetry();
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
    this.running = false;
    this.after();
  }

  // Whether the daemon has said what became of it.
  async #try() {
    try {
      const answer = await request("POST", "/v1/stop", { signal: AbortSignal.timeout(TRY_MS) });
      if (answer.ok) {
        this.#say("");
        return true;
      }
      if (answer.status === 401) {
        this.#say("STOP was refused: the daemon has another token since it was started anew. A daemon that starts is never armed.");
        return true;
      }
      if (answer.status === 503) {
        this.#say("The daemon has no link to the board. Without it the board ends dark by itself; in doubt use the emergency stop.");
        return true;
      }
    } catch {
      // Not answered: again.
    }
    return false;
  }

  #say(text) {
    this.line.hidden = !text;
    this.line.textContent = text;
  }
}
