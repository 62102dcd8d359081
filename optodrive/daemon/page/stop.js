// STOP: sent at once and repeated until the daemon answers; it depends on no other part of the page.
// Escape is STOP everywhere: the page has no dropdown, because the browser would close an open one with the key and
// not report it. What the browser opens itself is refused or watched while the laser may emit.

import { request } from "./api.js";

const TIMEOUT_MS = 1200;
const RETRY_MS = 300;
const FREE_MS = 100; // without an answer by then, the connections of other windows may be in the way

export class StopControl {
  // freeConnection: closes connections that may block the request; onAnswered: the daemon has answered
  // mayEmit(): returns whether the laser may emit; true if that is unknown
  // report(text): says how it goes
  constructor(button, status, freeConnection, onAnswered, mayEmit, report) {
    this.status = status;
    this.report = report;
    this.needsLink = false; // whether what is shown is that there is no link to the board
    this.freeConnection = freeConnection;
    this.onAnswered = onAnswered;
    this.running = false;
    button.addEventListener("click", () => this.stop());
    // Captured before any other handler of the page.
    window.addEventListener("keydown", (event) => this.#onKeyDown(event), { capture: true });
    window.addEventListener("contextmenu", (event) => mayEmit() && event.preventDefault(), { capture: true });
    // The browser reports only the end of a file dialog: Escape in it, or its Cancel.
    window.addEventListener("cancel", () => mayEmit() && this.stop(), { capture: true });
  }

  #onKeyDown(event) {
    if (event.key === "Escape" || event.code === "Escape") {
      event.preventDefault(); // Firefox would end the connections of the page
      this.stop();
    }
  }

  async stop() {
    if (this.running) {
      return;
    }
    this.running = true;
    this.#show("STOP sent …");
    for (let attempts = 1; !(await this.#attempt()); attempts++) {
      const count = `${attempts} ${attempts === 1 ? "attempt" : "attempts"}`;
      this.#say(`In doubt use the emergency stop or the key. STOP is not answered yet after ${count}; it is sent again.`);
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    }
    this.running = false;
    this.onAnswered();
  }

  // Send STOP once; return whether the daemon has answered.
  async #attempt() {
    const timer = setTimeout(this.freeConnection, FREE_MS);
    try {
      const response = await request("POST", "/v1/stop", { signal: AbortSignal.timeout(TIMEOUT_MS) });
      if (response.ok) {
        this.#show("");
        this.report("STOP is done: the laser is off, and the board is not armed.");
        return true;
      }
      if (response.status === 401) {
        this.#say("In doubt use the emergency stop or the key. STOP was refused: this page’s token was revoked, or the daemon was restarted and is not armed.");
        return true;
      }
      if (response.status === 503) {
        this.#say("In doubt use the emergency stop. The daemon has no link to the board, which switches the gate off by itself without one.");
        this.needsLink = true;
        return true;
      }
    } catch {
      // Not answered: retry.
    } finally {
      clearTimeout(timer);
    }
    return false;
  }

  // Note that the link to the board is up: what was said without it is past.
  noteLink() {
    if (this.needsLink) {
      this.#show("");
    }
  }

  #say(text) {
    this.#show(text);
    this.report(text);
  }

  #show(text) {
    this.needsLink = false;
    this.status.hidden = !text;
    this.status.textContent = text;
  }
}
