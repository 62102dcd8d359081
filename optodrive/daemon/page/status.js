// The board and the link in words: what state they are in, and what to do where they are not well.

import { BoardState, LEASED_STATES } from "./board_states.js";

const WORDS = { [BoardState.HOLD]: "HOLD, waiting for points" };

export class Status {
  constructor(find, say, acknowledge) {
    this.board = find("board");
    this.link = find("link");
    this.trouble = find("trouble");
    this.figures = find("figures");
    this.say = say;
    this.acknowledge = acknowledge;
    this.last = "";
    this.told = "";
  }

  showState(state) {
    const { board, link, totals } = state;
    const up = link.state === "up";
    pill(this.board, up ? `board: ${WORDS[board.state] ?? board.state}` : "board: no link", up ? kindOf(board.state) : "bad");
    const now = up ? board.state : "no link to the board";
    if (this.last && now !== this.last && ![BoardState.RUNNING, BoardState.HOLD].includes(now)) {
      this.say(`Board: ${now}`);
    }
    this.last = now;
    const rows = {
      Port: link.port,
      "Round trip": link.round_trip_ms === null ? "–" : `${link.round_trip_ms.toFixed(1)} ms`,
      "Sent again": link.retransmitted,
      Underruns: board.underruns,
      "Laser on": `${board.laser_on_s.toFixed(2)} s`,
      "Pulses executed": totals.executed,
      Queue: state.queue.running ? `${state.queue.running} runs, ${state.queue.waiting} wait` : `${state.queue.waiting} wait`,
      Temperature: board.temperature_c === null ? "–" : `${board.temperature_c.toFixed(1)} °C`,
    };
    this.figures.replaceChildren(...Object.entries(rows).flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
  }

  showFault(fault) {
    this.fault = fault;
    const lines = [];
    if (fault.link === "down") {
      lines.push(element("span", `No link to the board: ${fault.link_error ?? "it is lost"}. It is tried again by itself; the board stays disarmed.`));
    } else if (fault.fault) {
      lines.push(element("strong", `Fault: ${fault.fault}`), element("span", `${fault.hint}.`));
      const button = element("button", "Acknowledge");
      button.type = "button";
      button.id = "acknowledge";
      button.addEventListener("click", this.acknowledge);
      lines.push(button);
    }
    this.#tell(lines);
  }

  connection(live) {
    pill(this.link, live ? "live" : "no daemon, trying again", live ? "good" : "bad");
    if (!live) {
      pill(this.board, "board: not known", "bad");
      this.last = "";
      this.#tell([element("span", "The daemon does not answer; what is shown is not live. It is tried again by itself, and never armed by that.")]);
    }
  }

  stranger() {
    pill(this.link, "another token", "bad");
    const again = Object.assign(element("a", "Enter the new one"), { href: "/" });
    this.#tell([element("span", "The daemon has another token since it was started anew."), again]);
  }

  #tell(lines) {
    const words = lines.map((line) => line.textContent).join();
    if (words !== this.told) {
      this.told = words;
      this.trouble.replaceChildren(...lines);
      this.trouble.hidden = lines.length === 0;
    }
  }
}

function kindOf(state) {
  if (state === BoardState.FAULT) {
    return "bad";
  }
  return LEASED_STATES.includes(state) ? "warn" : "none";
}

function pill(item, text, kind) {
  if (item.textContent !== text) {
    item.textContent = text;
  }
  item.dataset.kind = kind;
}

function element(name, text) {
  return Object.assign(document.createElement(name), { textContent: text });
}
