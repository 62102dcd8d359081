// The header: its whole ground and its sign show whether the laser may emit; lamps show the safety inputs.

import { BoardState, INPUTS } from "./board_states.js";

const EMITTING_STATES = [BoardState.RUNNING, BoardState.HOLD];
const DARK_MS = 2000; // between the frames of a stream the board is ARMED for moments: these are not announced

// The sign's outline differs between states, so that they differ without colour; drawn on 24 × 24.
const SIGNS = {
  off: "M12 2a10 10 0 1 0 0 20 10 10 0 0 0 0-20zm0 3a7 7 0 1 1 0 14 7 7 0 0 1 0-14z",
  arming: "M12 2a10 10 0 1 0 0 20 10 10 0 0 0 0-20zm0 3a7 7 0 1 1 0 14 7 7 0 0 1 0-14zM12 7a5 5 0 0 1 0 10z",
  armed: "M12 1 24 22H0zM12 6 4 19.5h16zM11 10h2v5h-2zm0 6h2v2h-2z",
  emitting:
    "M12 0 14.2 5.3 19.1 2.3 17.7 7.9 23.4 8.3 19 12 23.4 15.7 17.7 16.1 19.1 21.7 14.2 18.7 12 24 9.8 18.7 4.9 21.7 6.3 16.1 .6 15.7 5 12 .6 8.3 6.3 7.9 4.9 2.3 9.8 5.3z",
  paused: "M3 2h18v20H3zM7 6h4v12H7zm6 0h4v12h-4z",
  hold: "M12 1a11 11 0 1 0 0 22 11 11 0 0 0 0-22zM8 7h3v10H8zm5 0h3v10h-3z",
  fault: "M7 1h10l6 6v10l-6 6H7l-6-6V7zM8 6 6 8l4 4-4 4 2 2 4-4 4 4 2-2-4-4 4-4-2-2-4 4z",
  unknown: "M12 0 24 12 12 24 0 12zM11 16h2v2h-2zM8 10a4 4 0 1 1 5 4v1h-2v-3a2 2 0 1 0-1-2z",
};
const LOOKS = {
  [BoardState.BOOT]: ["off", "the board starts"],
  [BoardState.DISARMED]: ["off", "the laser is off"],
  [BoardState.ARMING]: ["arming", "can emit after two seconds"],
  [BoardState.ARMED]: ["armed", "dark until a plan plays"],
  [BoardState.RUNNING]: ["emitting", "the laser emits"],
  [BoardState.HOLD]: ["hold", "waits for points, may emit"],
  [BoardState.FAULT]: ["fault", ""],
};
const LAMPS = {
  interlock: { name: "Interlock", safe: 1, words: ["open", "closed"] },
  key: { name: "Key", safe: 1, words: ["off", "on"] },
  estop: { name: "E-stop", safe: 0, words: ["released", "pressed"] },
};

export class Header {
  // report(topic, text): says what changed
  constructor(find, report) {
    this.bar = find("bar");
    this.sign = find("sign");
    this.word = find("board-state");
    this.meaning = find("board-means");
    this.linkPill = find("link");
    this.report = report;
    this.announced = "";
    this.darkTimer = null;
    this.lamps = INPUTS.map((input) => {
      const item = document.createElement("li");
      item.append(Object.assign(document.createElement("i"), { className: "lamp" }), document.createElement("span"));
      find("lamps").append(item);
      return { item, text: item.lastChild, ...LAMPS[input] };
    });
    this.lampList = find("lamps");
    this.limitation = find("limitation");
    this.showUnknown("no data yet");
  }

  // The state as one word, UNKNOWN without a link.
  get state() {
    return this.word.textContent;
  }

  showState({ board, link, queue }) {
    // A laser DAC has no inputs: lamps would claim that somebody watches them.
    this.lampList.hidden = link.limitation !== null;
    this.limitation.hidden = link.limitation === null;
    setText(this.limitation, link.limitation ?? "");
    const look = LOOKS[board.state];
    if (link.state !== "up" || !look) {
      this.showUnknown(describeUnknown(link));
      return;
    }
    if (queue.paused && board.state === BoardState.ARMED) {
      this.#show("paused", "PAUSED", `dark, armed for ${formatTime(queue.pause_ends_in_s)}`);
    } else {
      this.#show(look[0], board.state, board.fault ?? look[1]);
    }
    if (board.temperature_c === null) {
      this.#showInputs(null); // the board has not reported them yet
    } else {
      this.#showInputs(board.inputs);
    }
  }

  showUnknown(reason) {
    this.#show("unknown", "UNKNOWN", reason);
    this.#showInputs(null);
  }

  showConnection(text, kind) {
    setText(this.linkPill, text);
    this.linkPill.dataset.kind = kind;
  }

  #show(look, state, meaning) {
    if (this.bar.dataset.state !== look) {
      this.bar.dataset.state = look;
      this.sign.setAttribute("d", SIGNS[look]);
    }
    setText(this.word, state);
    setText(this.meaning, meaning);
    if (state === BoardState.ARMED && EMITTING_STATES.includes(this.announced)) {
      this.darkTimer ??= setTimeout(() => this.#announceState(state, meaning), DARK_MS);
    } else {
      this.#announceState(state, meaning);
    }
  }

  #announceState(state, meaning) {
    clearTimeout(this.darkTimer);
    this.darkTimer = null;
    const isRoutine = EMITTING_STATES.includes(state) && EMITTING_STATES.includes(this.announced);
    if (this.announced && state !== this.announced && !isRoutine) {
      this.report("board", `Board: ${state}, ${meaning}`);
    }
    this.announced = state;
  }

  // inputs: their bits, null if they are unknown
  #showInputs(inputs) {
    this.lamps.forEach(({ item, text, name, safe, words }, bit) => {
      const value = (inputs >> bit) & 1;
      const kind = inputs === null ? "unknown" : value === safe ? "safe" : "unsafe";
      setText(text, `${name} ${inputs === null ? "unknown" : words[value]}`);
      if ([kind, item.dataset.kind].every((each) => ["safe", "unsafe"].includes(each)) && kind !== item.dataset.kind) {
        this.report(name, text.textContent);
      }
      item.dataset.kind = kind;
    });
  }
}

// Why the state of the board is not known.
export function describeUnknown({ state, silence_s: silenceS }) {
  if (state !== "up") {
    return "no link to the board";
  }
  return silenceS > 0.5 ? "the board does not answer" : "no data yet";
}

function formatTime(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")} min`;
}

function setText(item, text) {
  if (item.textContent !== text) {
    item.textContent = text;
  }
}
