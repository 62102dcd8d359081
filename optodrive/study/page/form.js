// A questionnaire of a few fields.

const CHOICES_MAX = 6; // more are a list

export class Form {
  // find: returns the element with an id; onSend: gets the answers by the names of the questions
  constructor(find, onSend) {
    this.form = find("form");
    this.fields = find("fields");
    this.shown = "";
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      onSend(this.#read());
    });
  }

  // Show the questions, and keep what was filled in while they are the same.
  show(questions) {
    this.form.hidden = questions.length === 0;
    if (this.shown !== JSON.stringify(questions)) {
      this.shown = JSON.stringify(questions);
      this.questions = questions;
      this.fields.replaceChildren(...questions.map(buildField));
    }
  }

  #read() {
    const entries = new FormData(this.form);
    return Object.fromEntries(
      this.questions.map(({ name, kind }) => [name, kind === "number" ? Number(entries.get(name)) : entries.get(name)]),
    );
  }
}

function buildField({ name, question, kind, answers }) {
  return kind === "choice" && answers.length <= CHOICES_MAX ? buildChoices(name, question, answers) : buildInput(name, question, kind, answers);
}

function buildChoices(name, question, answers) {
  const group = document.createElement("fieldset");
  group.append(Object.assign(document.createElement("legend"), { textContent: question }));
  for (const answer of answers) {
    const label = document.createElement("label");
    label.append(Object.assign(document.createElement("input"), { type: "radio", name, value: answer, required: true }), ` ${answer}`);
    group.append(label);
  }
  return group;
}

function buildInput(name, question, kind, answers) {
  const label = document.createElement("label");
  const input = document.createElement(kind === "choice" ? "select" : "input");
  Object.assign(input, { name, required: true, autocomplete: "off" });
  if (kind === "choice") {
    input.append(new Option("", ""), ...answers.map((answer) => new Option(answer, answer)));
  } else {
    Object.assign(input, kind === "number" ? { type: "number", step: "any" } : { type: "text", maxLength: 200, pattern: ".*\\S.*" });
  }
  label.append(question, input);
  return label;
}
