// The participant's page. It shows the newest view of the session and sends what the participant does.

import { Announcer } from "./announcer.js";
import { Answers } from "./answers.js";
import { Form } from "./form.js";
import { INVALID, PageSocket, REPLACED, UNAUTHORISED } from "./page_socket.js";

const find = (id) => document.getElementById(id);
const announcer = new Announcer(find("said"));
const LOST = {
  [REPLACED]: ["replaced", "replaced_hint"],
  [UNAUTHORISED]: ["Not valid", "The address of this page is not valid, or no longer. Please tell the operator."],
  [INVALID]: ["Error", "Please tell the operator, and reload this page."],
};
const ENGLISH = { lost: "No connection", lost_hint: "Trying again. If this lasts, please tell the operator." };
const DURING = ["stimulus", "question", "rest", "pause"];

let view = null;
let said = "";
let place = "";
let texts = ENGLISH;
let marks = [];

const answers = new Answers(
  find,
  (answer, event) => sendAbout({ kind: "answer", answer, handled_s: measureDelay(event) }),
  () => sendAbout({ kind: "again" }),
);
const form = new Form(find, (filled) => socket.send({ kind: "form", answers: filled }));
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

// Return a sentence of the page; words in braces stand for values.
function sayText(key, values = {}) {
  return (texts[key] ?? key).replace(/\{(\w+)\}/g, (_, name) => values[name]);
}

function findLabel(answer) {
  return view.labels[view.answers.indexOf(answer)] ?? answer;
}

function describe({ phase, is_begun: isBegun, is_early: isEarly, example }) {
  switch (phase) {
    case "start":
      return isBegun ? [sayText("break"), sayText("break_hint")] : [sayText("ready"), sayText("ready_hint")];
    case "pause":
      return [sayText("pause"), sayText("pause_hint")];
    case "form":
      return [sayText("questions"), sayText("questions_hint")];
    case "example":
      return [sayText("feel"), sayText("example_hint", { number: example[0], count: example[1] })];
    case "stimulus":
      return [sayText("feel"), sayText("stimulus_hint")];
    case "question":
      return [sayText("answer_now"), isEarly ? sayText("early_hint") : ""];
    case "rest":
      return [sayText("wait"), describeRest(view)];
    case "done":
      return [sayText("done"), sayText("done_hint")];
    default:
      return [sayText("stopped"), sayText("stopped_hint")];
  }
}

// What became of the last answer, and what comes next.
function describeRest({ answered, has_missed: hasMissed, is_correct: isCorrect, correct, follows }) {
  return [
    answered !== null && sayText("answered", { answer: findLabel(answered) }),
    hasMissed && sayText("no_answer"),
    isCorrect === true && sayText("correct"),
    isCorrect === false && sayText("wrong", { answer: findLabel(correct) }),
    follows === "stimulus" && sayText("next"),
    follows === "break" && sayText("break_next"),
  ]
    .filter(Boolean)
    .join(" ");
}

function describeProgress({ phase, trial, trials, example, is_practice: isPractice, is_begun: isBegun }) {
  if (phase === "done") {
    return sayText("all_trials", { count: trials });
  }
  if (phase === "example") {
    return sayText("example", { number: example[0], count: example[1] });
  }
  if (phase === "form" || (phase === "start" && !isBegun)) {
    return sayText("trials", { count: trials });
  }
  return isPractice ? sayText("practice", { number: trial }) : sayText("trial", { number: trial, count: trials });
}

function onView({ view: number, ...newest }) {
  socket.send({ kind: "seen", view: number });
  view = newest;
  texts = view.texts;
  const { phase, trial, trials, announced } = view;
  const [state, hint] = describe(view);
  showTexts();
  show(phase, state, hint);
  find("progress-text").textContent = describeProgress(view);
  find("progress-bar").max = trials;
  find("progress-bar").value = phase === "done" || view.follows === "end" ? trials : view.is_practice ? 0 : trial - 1;
  document.title = `${view.title}: ${state}`;
  find("question").textContent = view.question;
  showInstructions(phase);
  form.show(view.questions);
  answers.show(view, announced !== null);
  const newPlace = JSON.stringify(announced);
  if (announced !== null && newPlace !== place) {
    place = newPlace;
    answers.reset(sayText("no_answer_yet"));
  }
  markParts(phase);
  say(phase, state, hint);
  keepFocus(phase);
}

// Show the number of each interval of the stimulus while it lasts.
function markParts(phase) {
  marks.forEach(clearTimeout);
  marks = (phase === "stimulus" ? view.parts : []).flatMap(([startS, endS], index) => [
    endS > 0 && setTimeout(() => (find("state").textContent = sayText("part", { number: index + 1 })), 1000 * startS),
    endS > 0 && setTimeout(() => (find("state").textContent = sayText("feel")), 1000 * endS),
  ]);
}

function showTexts() {
  document.documentElement.lang = view.language;
  const elements = { break: "take_break", "keys-text": "keys", "again-text": "again", confirm: "confirm", send: "send", "magnitude-label": "scale", "number-label": "number" };
  for (const [id, key] of Object.entries(elements)) {
    find(id).textContent = sayText(key);
  }
  find("begin").textContent = sayText(view.is_begun ? "continue" : "start");
}

function showInstructions(phase) {
  const paragraphs = (view.instructions ?? "").split(/\n\s*\n/).filter(Boolean);
  find("instructions").hidden = phase !== "start" || paragraphs.length === 0;
  find("instructions").replaceChildren(
    ...paragraphs.map((text) => Object.assign(document.createElement("p"), { textContent: text.trim() })),
  );
}

function show(phase, state, hint) {
  document.body.dataset.phase = phase;
  find("state").textContent = state;
  find("hint").textContent = hint;
  find("begin").hidden = phase !== "start";
  find("by-keys").hidden = ["done", "stopped", "lost", "form"].includes(phase);
  find("task").hidden = !DURING.includes(phase) || view?.follows === "end";
  find("break").hidden = ![...DURING, "example"].includes(phase) || view?.follows === "end";
  if (phase !== "form") {
    find("form").hidden = true;
  }
}

// Each state is said once, with its trial and, where there is one, the question.
function say(phase, state, hint) {
  const { trial, is_practice: isPractice, follows } = view;
  if (phase === "rest" && follows === null) {
    return; // what follows is not known yet: it is said with the answer
  }
  const parts = { stimulus: `${describeProgress(view)}. ${state}.`, question: `${state}. ${view.is_early ? `${hint} ` : ""}${view.question}` };
  const text = parts[phase] ?? `${/[.?!]$/.test(state) ? state : `${state}.`} ${hint}`;
  if (`${isPractice} ${trial} ${text}` !== said) {
    said = `${isPractice} ${trial} ${text}`;
    const instructions = phase === "start" ? (view.instructions ?? "") : "";
    announcer.say(`${text} ${instructions}`.trim());
  }
}

// The focus stays where it is, unless its element is hidden: then it goes to the button that waits, or to the state.
function keepFocus(phase) {
  const focused = document.activeElement;
  if (phase === "start") {
    find("begin").focus();
  } else if (phase === "question" && view.kind === "number") {
    find("number").focus();
  } else if (focused === document.body || !focused.checkVisibility()) {
    find("state").focus();
  }
}

function onLost(code, isTriedAgain) {
  if (isTriedAgain) {
    showLost(sayText("lost"), sayText("lost_hint"));
  } else if (LOST[code]) {
    showLost(...LOST[code].map((key) => sayText(key)));
  }
}

function showLost(state, hint) {
  show("lost", state, hint);
  if (said !== state) {
    said = state;
    announcer.say(`${state}. ${hint}`);
  }
  view = null;
}
