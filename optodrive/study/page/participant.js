// The participant's page. It shows the newest view of the session and sends what the participant does.

import { Announcer } from "./announcer.js";
import { Answers } from "./answers.js";
import { INVALID, PageSocket, REPLACED, UNAUTHORISED } from "./page_socket.js";

const find = (id) => document.getElementById(id);
const announcer = new Announcer(find("said"));
const LOST = {
  [REPLACED]: ["Not in use", "This page was opened in another window, which is in use now. Reload to use this one."],
  [UNAUTHORISED]: ["Not valid", "The address of this page is not valid, or no longer. Please tell the operator."],
  [INVALID]: ["Error", "Please tell the operator, and reload this page."],
};

let view = null;
let said = "";
let place = "";

const answers = new Answers(
  find,
  (answer, event) => sendAbout({ kind: "answer", answer, handled_s: measureDelay(event) }),
  () => sendAbout({ kind: "again" }),
);
const socket = new PageSocket("participant/socket", onView, onLost);
find("begin").addEventListener("click", () => socket.send({ kind: "ready" }));
find("break").addEventListener("click", () => socket.send({ kind: "break" }));

// Time from a key or touch to now, s, by the browser's clock.
function measureDelay(event) {
  return Math.max(0, performance.now() - event.timeStamp) / 1000;
}

// Send a message about the stimulus that this page shows.
function sendAbout(message) {
  if (view?.announced) {
    socket.send({ ...message, ...view.announced });
  }
}

function describe({ phase, is_begun: isBegun, is_early: isEarly, example, answered }) {
  switch (phase) {
    case "start":
      return isBegun
        ? ["Break", "Place your finger on the display. Press Continue when you are ready."]
        : ["Ready?", "Place your finger on the display. Press Start when you are ready."];
    case "pause":
      return ["Pause", "The study goes on when the operator continues."];
    case "example":
      return ["Feel", `Example ${example[0]} of ${example[1]}. No answer is needed.`];
    case "stimulus":
      return ["Feel", "Answer when the stimulus has ended."];
    case "question":
      return ["Answer now", isEarly ? "You answered before the stimulus had ended. Please answer now." : ""];
    case "rest":
      return ["Wait", answered === null ? "The next stimulus comes." : `Your answer: ${answered}. The next stimulus comes.`];
    case "done":
      return ["Finished", "Thank you. You may take your finger away."];
    default:
      return ["Stopped", "Please wait for the operator."];
  }
}

function onView({ view: number, ...newest }) {
  socket.send({ kind: "seen", view: number });
  view = newest;
  const { phase, trial, trials, announced } = view;
  const [state, hint] = describe(view);
  show(phase, state, hint);
  find("progress-text").textContent = phase === "done" ? `All ${trials} trials` : `Trial ${trial} of ${trials}`;
  find("progress-bar").max = trials;
  find("progress-bar").value = phase === "done" ? trials : trial - 1;
  document.title = `${view.title}: ${state}`;
  find("question").textContent = view.question;
  answers.show(view, announced !== null);
  const newPlace = JSON.stringify(announced);
  if (announced !== null && newPlace !== place) {
    place = newPlace;
    answers.reset();
  }
  find("begin").textContent = view.is_begun ? "Continue" : "Start";
  say(phase, state, hint);
  keepFocus(phase);
}

function show(phase, state, hint) {
  document.body.dataset.phase = phase;
  find("state").textContent = state;
  find("hint").textContent = hint;
  find("begin").hidden = phase !== "start";
  find("by-keys").hidden = ["done", "stopped", "lost"].includes(phase);
  find("task").hidden = !["stimulus", "question", "rest", "pause"].includes(phase);
  find("break").hidden = !["stimulus", "question", "rest", "pause", "example"].includes(phase);
}

// Each state is said once, with its trial and, where there is one, the question.
function say(phase, state, hint) {
  const { trial, trials } = view;
  const parts = { stimulus: `Trial ${trial} of ${trials}. ${state}.`, question: `${state}. ${view.is_early ? `${hint} ` : ""}${view.question}` };
  const text = parts[phase] ?? `${/[.?!]$/.test(state) ? state : `${state}.`} ${hint}`;
  if (`${trial} ${text}` !== said) {
    said = `${trial} ${text}`;
    announcer.say(text);
  }
}

// The focus stays where it is, unless its element is hidden: then it goes to the button that waits, or to the state.
function keepFocus(phase) {
  const focused = document.activeElement;
  if (phase === "start") {
    find("begin").focus();
  } else if (focused === document.body || !focused.checkVisibility()) {
    find("state").focus();
  }
}

function onLost(code, isTriedAgain) {
  if (isTriedAgain) {
    showLost("No connection", "Trying again. If this lasts, please tell the operator.");
  } else if (LOST[code]) {
    showLost(...LOST[code]);
  }
}

function showLost(state, hint) {
  view = null;
  show("lost", state, hint);
  if (said !== state) {
    said = state;
    announcer.say(`${state}. ${hint}`);
  }
}
