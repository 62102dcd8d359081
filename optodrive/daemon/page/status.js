// What to do about a fault, and the figures of the board and the link.

export class Status {
  // onControlAdded: called after a control has been added to the page; report(text): says an alert, "" its end
  constructor(find, acknowledge, onControlAdded, report) {
    this.alert = find("trouble");
    this.nextPlace = find("laser-title");
    this.stats = find("figures");
    this.acknowledge = acknowledge;
    this.onControlAdded = onControlAdded;
    this.report = report;
    this.alertText = "";
  }

  // isKnown: whether the board reports; what it reported last is no figure of now
  showState(state, isKnown) {
    const { board, link, totals } = state;
    const ofBoard = (text) => (isKnown ? text : "–");
    const rows = {
      Port: link.port,
      "Round trip": link.round_trip_ms === null ? "–" : `${link.round_trip_ms.toFixed(1)} ms`,
      Retransmitted: link.retransmitted,
      Underruns: ofBoard(board.underruns),
      "Laser on": ofBoard(`${board.laser_on_s.toFixed(2)} s`),
      "Pulses executed": hasPlanner(state) ? totals.executed : "–",
      "Streamed frames shown": hasPlanner(state) ? totals.frames_shown : "–",
      "Board temperature": ofBoard(board.temperature_c === null ? "–" : `${board.temperature_c.toFixed(1)} °C`),
      ...describeHeat(state.limits),
      ...Object.fromEntries(state.stages.map((stage) => [`Stage ${stage.name}`, describeStage(stage)])),
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
      const controls = Object.assign(document.createElement("fieldset"), { className: "bare" });
      Object.assign(controls.dataset, { route: "POST /v1/disarm", action: "Acknowledging" });
      controls.append(button);
      items.push(controls);
    }
    this.#showAlert(items);
  }

  showNoDaemon() {
    this.#showAlert([createElement("span", "The daemon does not answer; the display is not live. The page reconnects automatically and never arms.")]);
  }

  // reason: why the token is revoked; "" if that is not known
  showInvalidToken(reason) {
    const login = Object.assign(createElement("a", "Enter another one"), { href: "./" });
    const text = reason ? `${reason[0].toUpperCase()}${reason.slice(1)}` : "The daemon does not know this page’s token: it was revoked, or the daemon was restarted";
    const advice = "In doubt use the emergency stop or the key: STOP of this page is refused, and the display is not live.";
    this.#showAlert([createElement("strong", advice), createElement("span", `${text}.`), login]);
  }

  #showAlert(items) {
    const text = items.map((item) => item.textContent).join();
    const sentences = items.filter((item) => item.matches("strong, span")).map((item) => item.textContent);
    if (text !== this.alertText) {
      const hadFocus = this.alert.contains(document.activeElement);
      this.alertText = text;
      this.report(sentences.map((each) => (each.endsWith(".") ? each : `${each}.`)).join(" "));
      this.alert.replaceChildren(...items);
      this.alert.hidden = items.length === 0;
      if (hadFocus) {
        this.nextPlace.focus(); // the button that had it is gone
      }
      this.onControlAdded();
    }
  }
}

// Whether the planner process runs, without which nothing is known of plans.
export const hasPlanner = ({ limits }) => limits.power_share !== null;

// Why plans get less light than later, while the display counts as hot.
const describeHeat = ({ hot_reason: reason, hot_for_s: duration }) => (reason ? { "Less light": `for ${Math.ceil(duration / 60)} min: the display counts as hot, because ${reason}` } : {});

// One of several stages: the state of its board, and its clock against the host's; lost or without a link its cause.
function describeStage({ board, connected, error: cause, lost, clock_error_us: error, clock_drift_ppm: drift }) {
  if (lost !== null) return `lost, the others go on: ${lost}`;
  if (!connected) return `no link: ${cause}`;
  const state = board.fault === null ? board.state : `${board.state} ${board.fault}`;
  return error === null ? `${state}, clock unknown` : `${state}, clock ±${error.toFixed(0)} µs, ${drift > 0 ? "+" : ""}${drift.toFixed(1)} ppm`;
}

function createElement(name, text) {
  return Object.assign(document.createElement(name), { textContent: text });
}
