// Arming in two steps: one button requests it, another confirms it within five seconds. The page never arms by itself.

import { call } from "./api.js";
import { BoardState } from "./board_states.js";

const CONFIRM_S = 5;
const TEXTS = {
  [BoardState.ARMING]: "The indicator is on; the laser can emit after two seconds.",
  [BoardState.ARMED]: "Armed: the laser emits as soon as a plan plays.",
  [BoardState.RUNNING]: "The laser emits. STOP ends everything; End ends what plays.",
  [BoardState.HOLD]: "The board waits for points, and may emit again at any time.",
  [BoardState.FAULT]: "Acknowledge the fault before you arm.",
};
const PAUSED_TEXT = "Paused: the laser is off. Resume plays what is left.";

export class ArmControl {
  constructor(find, announce, onError) {
    this.button = find("arm");
    this.confirmButton = find("confirm-arm");
    this.countdown = find("confirm-left");
    this.status = find("arming");
    this.holder = find("control");
    this.idleText = this.status.textContent;
    this.status.closest(".reserve").dataset.longest = this.idleText;
    this.announce = announce;
    this.onError = onError;
    this.state = "";
    this.isPaused = false;
    this.button.addEventListener("click", () => this.#requestConfirmation());
    this.confirmButton.addEventListener("click", () => this.#confirm());
    find("disarm").addEventListener("click", () => this.disarm());
  }

  // Show the board's state; '' if it is unknown. isPaused: whether the light is paused
  show(state, isPaused = false) {
    if (state !== this.state || isPaused !== this.isPaused) {
      this.state = state;
      this.isPaused = isPaused;
      this.#setEnabled(state === BoardState.DISARMED);
      const isDark = isPaused && state === BoardState.ARMED;
      this.status.textContent = isDark ? PAUSED_TEXT : (TEXTS[state] ?? this.idleText);
      if (state !== BoardState.DISARMED) {
        this.#closeConfirmation();
      }
    }
  }

  // Show who armed the board; ownName: the name of this page's token.
  showControl(control, ownName) {
    this.holder.hidden = control === null;
    if (control) {
      const { caller, armed_for_s, hold } = control;
      const who = `${caller}${caller === ownName ? " (this page’s token)" : ""}`;
      this.holder.textContent = `Armed by ${who} ${describeAge(armed_for_s)}${hold ? ", while held" : ""}.`;
    }
  }

  async disarm() {
    this.#closeConfirmation();
    await call("POST", "/v1/disarm").catch(this.onError);
  }

  // A button that is disabled loses the focus; this one keeps it and does nothing.
  #setEnabled(enabled) {
    this.button.setAttribute("aria-disabled", !enabled);
  }

  #requestConfirmation() {
    if (this.button.getAttribute("aria-disabled") === "true") {
      return;
    }
    this.deadline = performance.now() + CONFIRM_S * 1000;
    this.confirmButton.hidden = this.countdown.hidden = false;
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
    if (document.activeElement === this.confirmButton) {
      this.button.focus();
    }
    this.confirmButton.hidden = this.countdown.hidden = true;
  }

  async #confirm() {
    if (this.confirmButton.hidden || performance.now() > this.deadline) {
      return;
    }
    this.#closeConfirmation();
    this.#setEnabled(false);
    await call("POST", "/v1/arm").catch(this.onError);
    this.#setEnabled(this.state === BoardState.DISARMED);
  }
}

function describeAge(seconds) {
  const [amount, unit] = seconds < 120 ? [seconds, "s"] : seconds < 7200 ? [seconds / 60, "min"] : [seconds / 3600, "h"];
  return `${Math.floor(amount)} ${unit} ago`;
}
