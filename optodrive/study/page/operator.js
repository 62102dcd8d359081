// The operator's page: the newest view of the session beside its participant, pause, and STOP.

import { Announcer } from "./announcer.js";
import { PageSocket, UNAUTHORISED } from "./page_socket.js";

const find = (id) => document.getElementById(id);
const announcer = new Announcer(find("said"));
const STATES = {
  start: "Waits for the participant’s button",
  pause: "Paused",
  form: "Questionnaire",
  example: "Example without a question",
  stimulus: "Stimulus",
  question: "Waits for the answer",
  rest: "Between two trials",
  done: "All trials are done",
  stopped: "The run has ended before its last trial",
  lost: "No connection to the study: trying again",
};

let view = null;
let said = "";
const socket = new PageSocket("operator/socket", onView, onLost);

find("pause").addEventListener("click", () => {
  if (isLive()) {
    socket.send({ kind: view.is_paused ? "resume" : "pause" });
  }
});
find("stop").addEventListener("click", stop);
addEventListener("keydown", (event) => event.key === "Escape" && !event.repeat && stop());
find("copy").addEventListener("click", () => navigator.clipboard.writeText(buildParticipantUrl()));

// The participant's page is beside this one, also behind a proxy.
function buildParticipantUrl() {
  return new URL(`participant#token=${view.participant_token}`, location.href).href;
}

function isLive() {
  return view !== null && !["done", "stopped"].includes(view.phase);
}

function stop() {
  if (isLive()) {
    socket.send({ kind: "stop" });
    say("STOP is sent.");
  } else {
    showNotice("This page has no session to stop: use the daemon’s page, optodrive stop, or the emergency stop.");
  }
}

function onView(newest) {
  view = newest;
  const { phase, trial, trials, answered, correct, example } = view;
  find("title").textContent = view.title;
  find("participant").textContent = `Participant ${view.participant}`;
  document.title = `${view.title}, ${view.participant}: operator`;
  showState(phase);
  const number = view.is_practice ? `Practice trial ${trial}` : `Trial ${trial} of ${trials}`;
  const which = example ? `Example ${example[0]} of ${example[1]}` : `${number}${view.block && !view.is_practice ? `, block ${view.block}` : ""}`;
  find("progress-text").textContent = `${which}. Answered: ${answered}${correct === null ? "" : `, of them ${correct} correct`}.`;
  find("progress-bar").max = trials;
  find("progress-bar").value = answered;
  find("pause").textContent = view.is_paused ? "Go on" : "Pause";
  find("pause").setAttribute("aria-disabled", !isLive());
  find("address").textContent = buildParticipantUrl();
  showPage();
  showNow();
  find("rows").replaceChildren(...view.rows.toReversed().map(buildRow));
  find("none").hidden = view.rows.length > 0;
  showNotice(view.notice);
}

function showState(phase) {
  document.body.dataset.phase = phase;
  const isAbsent = view && phase === "start" && !view.is_present;
  const text = isAbsent ? "Waits for the participant’s page" : STATES[phase];
  find("state").textContent = text;
  if (["start", "pause", "done", "stopped", "lost"].includes(phase)) {
    say(`${text}.`); // not each trial's states, which would never end
  }
}

function say(text) {
  if (text !== said) {
    said = text;
    announcer.say(text);
  }
}

function showPage() {
  const pill = find("page");
  pill.hidden = !isLive();
  pill.textContent = view.is_ready ? "Participant ready" : view.is_present ? "Participant’s page open" : "No participant’s page";
  pill.dataset.kind = view.is_ready ? "good" : view.is_present ? "none" : "bad";
}

function showNow() {
  const { announced, condition, executed, stimulus } = view;
  const lines = [
    ["Requested", view.is_catch ? "catch trial" : condition ? `${stimulus}: ${describe(condition)}` : stimulus],
    ["Executed", executed ? describeExecuted(executed) : announced ? "being shown" : ""],
    ["Attempt", announced ? `${announced.attempt}, presentation ${announced.presentation}` : ""],
  ];
  find("now").replaceChildren(...lines.flatMap(([name, text]) => [build("dt", name), build("dd", text || "—")]));
}

function describe(values) {
  return Object.entries(values).map(([name, value]) => `${name} ${value}`).join(", ");
}

function describeExecuted({ pulses, duration_s: durationS, onset_s: onsetS }) {
  if (onsetS === null) {
    return `nothing, for ${durationS.toFixed(3)} s`;
  }
  return `${pulses} pulses in ${durationS.toFixed(3)} s from ${onsetS.toFixed(6)} s of the board’s clock`;
}

function buildRow(row) {
  const mark = { true: "correct", false: "wrong", null: "" }[row.is_correct];
  const notes = [
    row.is_practice && "practice",
    row.is_catch && "catch trial",
    row.attempt > 1 && `attempt ${row.attempt}`,
    row.presentations > 1 && `shown ${row.presentations} times`,
    row.early_answers > 0 && `${row.early_answers} early`,
  ].filter(Boolean);
  const cells = [
    build("td", row.trial, "number"),
    build("td", row.is_catch ? "nothing" : describe(row.condition)),
    build("td", row.answer === null ? "none in time" : mark ? `${row.answer}, ${mark}` : row.answer, mark === "wrong" ? "wrong" : ""),
    build("td", row.response_time_s === null ? "" : row.response_time_s.toFixed(3), "number"),
    build("td", row.response_latency_s === null ? "" : row.response_latency_s.toFixed(3), "number"),
    build("td", `${row.pulses} pulses, ${row.duration_s.toFixed(3)} s`),
    build("td", notes.join(", ")),
  ];
  const line = document.createElement("tr");
  line.append(...cells);
  return line;
}

function build(tag, text, className = "") {
  return Object.assign(document.createElement(tag), { textContent: text, className });
}

function showNotice(text) {
  if (find("notice").textContent !== text) {
    find("notice").textContent = text;
  }
  find("notice").hidden = !text;
}

function onLost(code, isTriedAgain) {
  if (isTriedAgain) {
    view = null;
    showState("lost");
    find("pause").setAttribute("aria-disabled", true);
  } else if (code === UNAUTHORISED) {
    view = null;
    showNotice("The address of this page is not valid, or no longer: the study printed the present one when it began.");
  }
}
