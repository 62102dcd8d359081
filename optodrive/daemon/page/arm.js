// Arming, deliberately: one control asks, another confirms within five seconds. Never by itself.

import { call } from "./api.js";
import { ARMED_STATES, BoardState } from "./board_states.js";

const CONFIRM_S = 5;

export class Arm {
  constructor(find, say, failed) {
    this.button = find("arm");
    this.box = find("confirm");
    this.left = find("confirm-left");
    this.line = find("arming");
    this.idle = this.line.textContent;
    this.say = say;
    this.failed = failed;
    this.state = "";
    this.button.addEventListener("click", () => this.#ask());
    find("confirm-arm").addEventListener("click", () => this.#confirm());
    find("disarm").addEventListener("click", () => this.disarm());
  }

  // The board's state, '' where it is not known.
  show(state) {
    if (state !== this.state) {
      this.state = state;
      this.button.disabled = state !== BoardState.DISARMED;
      this.line.textContent =
        state === BoardState.ARMING
          ? "The indicator is lit; the laser can emit when its two seconds are over."
          : ARMED_STATES.includes(state)
            ? "ARMED: the laser emits when a plan plays."
            : this.idle;
      if (state !== BoardState.DISARMED) {
        this.#close();
      }
    }
  }

  async disarm() {
    this.#close();
    await call("POST", "/v1/disarm").catch(this.failed);
  }

  #ask() {
    this.until = performance.now() + CONFIRM_S * 1000;
    this.box.hidden = false;
    this.say("To arm the laser, press the button Confirm within five seconds.");
    clearInterval(this.timer);
    this.timer = setInterval(() => this.#count(), 100);
    this.#count();
  }

  #count() {
    const left = (this.until - performance.now()) / 1000;
    this.left.value = Math.max(0, left);
    if (left <= 0) {
      this.#close();
      this.say("Not armed.");
    }
  }

  #close() {
    clearInterval(this.timer);
    this.box.hidden = true;
  }

  async #confirm() {
    if (this.box.hidden || performance.now() > this.until) {
      return;
    }
    this.#close();
    this.button.disabled = true;
    await call("POST", "/v1/arm").catch(this.failed);
    this.button.disabled = this.state !== BoardState.DISARMED;
  }
}
