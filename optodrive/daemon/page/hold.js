// Hold to run: the board is armed while the button is held down, and no longer than this page lives and beats.
// Held with a pointer, Space or Enter. What was previewed plays once the board is armed; releasing ends everything.

import { token } from "./api.js";
import { BoardState } from "./board_states.js";

const BEAT_MS = 250; // the daemon disarms after a second without a beat
const KEYS = [" ", "Enter"];

export class HoldControl {
  // onArmed: called when the board is armed by this page's hold
  constructor(find, announce, onArmed) {
    this.button = find("hold");
    this.ended = find("hold-ended");
    this.announce = announce;
    this.onArmed = onArmed;
    this.socket = null;
    this.state = "";
    const { button } = this;
    button.addEventListener("pointerdown", (event) => event.button === 0 && this.#begin(event.pointerId));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) {
      button.addEventListener(end, () => this.release());
    }
    button.addEventListener("keydown", (event) => {
      if (KEYS.includes(event.key)) {
        event.preventDefault();
        if (!event.repeat) {
          this.#begin();
        }
      }
    });
    button.addEventListener("keyup", (event) => KEYS.includes(event.key) && this.release());
    button.addEventListener("contextmenu", (event) => event.preventDefault()); // a long press would open it
    window.addEventListener("blur", () => this.release());
    window.addEventListener("pagehide", () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
  }

  // Show the board's state; "" if it is unknown.
  show(state) {
    this.state = state;
    this.button.setAttribute("aria-disabled", this.socket === null && state !== BoardState.DISARMED);
  }

  // End the arming that this page holds.
  release() {
    const { socket } = this;
    if (socket) {
      this.#forget();
      socket.close(1000);
      this.announce("Released: the laser is off.");
    }
  }

  #begin(pointer) {
    if (this.socket || this.state !== BoardState.DISARMED) {
      return;
    }
    if (pointer !== undefined) {
      this.button.setPointerCapture(pointer);
    }
    const socket = new WebSocket(new URL("v1/hold", location.href.split("#")[0].replace("http", "ws")), ["optodrive", `bearer.${encodeBase64url(token())}`]);
    this.socket = socket;
    this.button.toggleAttribute("data-held", true);
    const beat = () => socket.readyState === WebSocket.OPEN && socket.send("beat");
    this.timer = setInterval(beat, BEAT_MS);
    socket.addEventListener("open", beat);
    socket.addEventListener("message", ({ data }) => this.socket === socket && this.#onReport(JSON.parse(data)));
    socket.addEventListener("close", ({ reason }) => {
      if (this.socket === socket) {
        this.#forget();
        this.#showEnd(`No longer held: ${reason || "the connection to the daemon ended"}.`);
      }
    });
    this.#showEnd("");
    this.announce("Arming while you hold.");
  }

  #onReport(report) {
    if (report.status === "armed") {
      this.announce("Armed while you hold.");
      this.onArmed();
    } else {
      this.#forget();
      this.#showEnd(report.status === "refused" ? `Not armed: ${report.problem.detail}.` : `No longer held: ${report.reason}.`);
    }
  }

  // Show why it ended although the button is held down.
  #showEnd(text) {
    this.ended.hidden = !text;
    this.ended.textContent = text;
    this.announce(text);
  }

  #forget() {
    clearInterval(this.timer);
    this.socket = null;
    this.button.toggleAttribute("data-held", false);
    this.show(this.state);
  }
}

function encodeBase64url(text) {
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}
