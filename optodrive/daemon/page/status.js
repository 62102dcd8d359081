// State of the board and the link, and what to do about a fault.

import { BoardState, LEASED_STATES } from "./board_states.js";

const STATE_LABELS = { [BoardState.HOLD]: "HOLD, waiting for points" };

export class Status {
  constructor(find, announce, acknowledge) {
    this.boardPill = find("board");
    this.linkPill = find("link");
    this.alert = find("trouble");
    this.stats = find("figures");
    this.announce = announce;
    this.acknowledge = acknowledge;
    this.announcedState = "";
    this.alertText = "";
  }

  showState(state) {
    const { board, link, totals } = state;
    const linked = link.state === "up";
    const label = linked ? `board: ${STATE_LABELS[board.state] ?? board.state}` : "board: no link";
    setPill(this.boardPill, label, linked ? selectKind(board.state) : "bad");
    const current = linked ? board.state : "no link to the board";
    if (this.announcedState && current !== this.announcedState && ![BoardState.RUNNING, BoardState.HOLD].includes(current)) {
      this.announce(`Board: ${current}`);
    }
    this.announcedState = current;
    const waiting = `${state.queue.waiting} waiting`;
    const rows = {
      Port: link.port,
      "Round trip": link.round_trip_ms === null ? "–" : `${link.round_trip_ms.toFixed(1)} ms`,
      Retransmitted: link.retransmitted,
      Underruns: board.underruns,
      "Laser on": `${board.laser_on_s.toFixed(2)} s`,
      "Pulses executed": totals.executed,
      Queue: state.queue.running ? `${state.queue.running} running, ${waiting}` : waiting,
      Temperature: board.temperature_c === null ? "–" : `${board.temperature_c.toFixed(1)} °C`,
    };
    this.stats.replaceChildren(...Object.entries(rows).flatMap(([name, value]) => [createElement("dt", name), createElement("dd", value)]));
  }

  showFault(fault) {
    const items = [];
    if (fault.link === "down") {
      const cause = fault.link_error ?? "it is lost";
      items.push(createElement("span", `No link to the board: ${cause}. The daemon reconnects automatically; the board stays disarmed.`));
    } else if (fault.fault) {
      items.push(createElement("strong", `Fault: ${fault.fault}`), createElement("span", `${fault.hint}.`));
      const button = createElement("button", "Acknowledge");
      button.type = "button";
      button.id = "acknowledge";
      button.addEventListener("click", this.acknowledge);
      items.push(button);
    }
    this.#showAlert(items);
  }

  showConnection(live) {
    setPill(this.linkPill, live ? "live" : "no daemon, trying again", live ? "good" : "bad");
    if (!live) {
      setPill(this.boardPill, "board: unknown", "bad");
      this.announcedState = "";
      this.#showAlert([createElement("span", "The daemon does not answer; the display is not live. The page reconnects automatically and never arms.")]);
    }
  }

  showTokenChange() {
    setPill(this.linkPill, "another token", "bad");
    const login = Object.assign(createElement("a", "Enter the new one"), { href: "/" });
    this.#showAlert([createElement("span", "The daemon was restarted and has another token."), login]);
  }

  #showAlert(items) {
    const text = items.map((item) => item.textContent).join();
    if (text !== this.alertText) {
      this.alertText = text;
      this.alert.replaceChildren(...items);
      this.alert.hidden = items.length === 0;
    }
  }
}

function selectKind(state) {
  if (state === BoardState.FAULT) {
    return "bad";
  }
  return LEASED_STATES.includes(state) ? "warn" : "none";
}

function setPill(item, text, kind) {
  if (item.textContent !== text) {
    item.textContent = text;
  }
  item.dataset.kind = kind;
}

function createElement(name, text) {
  return Object.assign(document.createElement(name), { textContent: text });
}
