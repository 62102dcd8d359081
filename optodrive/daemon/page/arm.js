// Arming in two steps: one button requests it, another confirms it within five seconds. The page never arms by itself.

import { call } from "./api.js";
import { ARMED_STATES, BoardState } from "./board_states.js";

const CONFIRM_S = 5;

export class ArmControl {
  constructor(find, announce, onError) {
    this.button = find("arm");
    this.confirmation = find("confirm");
    this.countdown = find("confirm-left");
    this.status = find("arming");
    this.idleText = this.status.textContent;
    this.announce = announce;
    this.onError = onError;
    this.state = "";
    this.button.addEventListener("click", () => this.#requestConfirmation());
    find("confirm-arm").addEventListener("click", () => this.#confirm());
    find("disarm").addEventListener("click", () => this.disarm());
  }

  // Show the board's state; '' if it is unknown.
  show(state) {
    if (state !== this.state) {
      this.state = state;
      this.button.disabled = state !== BoardState.DISARMED;
      this.status.textContent =
        state === BoardState.ARMING
          ? "The indicator is on; the laser can emit after two seconds."
          : ARMED_STATES.includes(state)
            ? "ARMED: the laser emits when a plan plays."
            : this.idleText;
      if (state !== BoardState.DISARMED) {
        this.#closeConfirmation();
      }
    }
  }

  async disarm() {
    this.#closeConfirmation();
    await call("POST", "/v1/disarm").catch(this.onError);
  }

  #requestConfirmation() {
    this.deadline = performance.now() + CONFIRM_S * 1000;
    this.confirmation.hidden = false;
    this.announce("To arm the laser, press the button Confirm within five seconds.");
    clearInterval(this.timer);
    this.timer = setInterval(() => this.#updateCountdown(), 100);
    this.#updateCountdown();
  }

  #updateCountdown() {
    const remainingS = (this.deadline - performance.now()) / 1000;
    this.countdown.value = Math.max(0, remainingS);
    if (remainingS <= 0) {
      this.#closeConfirmation();
      this.announce("Not armed.");
    }
  }

  #closeConfirmation() {
    clearInterval(this.timer);
    this.confirmation.hidden = true;
  }

  async #confirm() {
    if (this.confirmation.hidden || performance.now() > this.deadline) {
      return;
    }
    this.#closeConfirmation();
    this.button.disabled = true;
    await call("POST", "/v1/arm").catch(this.onError);
    this.button.disabled = this.state !== BoardState.DISARMED;
  }
}
