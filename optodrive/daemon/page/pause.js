// Pause and resume: one button. The light goes off, the board stays armed, and plans wait.

import { call } from "./api.js";
import { ARMED_STATES } from "./board_states.js";

const TEXTS = {
  pause: "Paused: the laser is off. The board stays armed, and plans wait.",
  resume: "Resumed: the laser emits as soon as a plan plays.",
};

export class PauseControl {
  constructor(find, announce, onError) {
    this.button = find("pause");
    this.announce = announce;
    this.onError = onError;
    this.paused = false;
    this.button.addEventListener("click", () => this.#toggle());
    this.show("", null);
  }

  // state: of the board, "" if it is unknown; queue: as the daemon reports it, null if it is unknown
  show(state, queue) {
    this.paused = queue !== null && queue.paused;
    this.button.textContent = this.paused ? "Resume" : "Pause";
    // A button that is disabled loses the focus; this one keeps it and does nothing.
    this.button.setAttribute("aria-disabled", !ARMED_STATES.includes(state));
  }

  async #toggle() {
    if (this.button.getAttribute("aria-disabled") === "true") {
      return;
    }
    const command = this.paused ? "resume" : "pause";
    try {
      const { board, queue } = await call("POST", `/v1/${command}`);
      this.show(board.state, queue);
      this.announce(TEXTS[command]);
    } catch (error) {
      this.onError(error);
    }
  }
}
