// The answers of a study as buttons and keys, a scale for a magnitude, or a field for a number.

const AGAIN_KEY = "0";
const NUMBER_MAX = 1e9;
const POSITIONS = "123456789abcdefghijklmnopqrstuvwxyz";

// Return the key of each answer: its first letter or digit if these differ from each other, else its position.
export function assignKeys(answers) {
  const firsts = answers.map((answer) => answer[0].toLowerCase());
  const isUsable = firsts.every((key) => /^[a-z1-9]$/.test(key)) && new Set(firsts).size === firsts.length;
  return answers.map((_, index) => (isUsable ? firsts[index] : POSITIONS[index] ?? ""));
}

// A decimal comma is a point.
function readNumber(text) {
  return text.trim() === "" ? NaN : Number(text.trim().replace(",", "."));
}

export class Answers {
  // find: returns the element with an id; onAnswer: gets an answer and the event that gave it; onAgain: gets its event
  constructor(find, onAnswer, onAgain) {
    this.group = find("answers");
    this.scale = find("scale");
    this.magnitude = find("magnitude");
    this.line = find("line");
    this.number = find("number");
    this.value = find("value");
    this.confirm = find("confirm");
    this.again = find("again");
    this.keys = find("keys");
    this.onAnswer = onAnswer;
    this.onAgain = onAgain;
    this.shown = "";
    this.byKey = new Map();
    this.magnitude.addEventListener("input", () => this.#chooseMagnitude());
    this.number.addEventListener("input", () => this.#chooseNumber());
    this.number.addEventListener("keydown", (event) => event.key === "Enter" && this.#confirm(event));
    this.confirm.addEventListener("click", (event) => this.#confirm(event));
    this.again.addEventListener("click", onAgain);
    addEventListener("keydown", (event) => this.#onKey(event));
  }

  // Show the answers of a study; isAccepted: whether they are about a stimulus now.
  show({ kind, answers, labels, again }, isAccepted) {
    const shown = JSON.stringify([kind, answers, labels, again]);
    if (this.shown !== shown) {
      this.shown = shown;
      this.kind = kind;
      this.group.hidden = kind !== "choice";
      this.scale.hidden = kind === "choice";
      this.line.hidden = this.value.hidden = kind !== "magnitude";
      this.number.hidden = kind !== "number";
      this.again.hidden = !again;
      this.#buildButtons(answers, labels, again);
    }
    this.isAccepted = isAccepted;
    for (const button of [...this.group.children, this.again]) {
      button.setAttribute("aria-disabled", !isAccepted);
    }
  }

  // Forget the magnitude or number of the trial before. text: what stands for no answer
  reset(text) {
    this.magnitude.value = 0.5;
    this.number.value = "";
    this.value.textContent = text;
    this.confirm.setAttribute("aria-disabled", "true");
  }

  #buildButtons(answers, labels, again) {
    const keys = assignKeys(labels);
    this.group.dataset.count = answers.length;
    this.group.replaceChildren();
    this.byKey.clear();
    answers.forEach((answer, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = labels[index];
      if (keys[index]) {
        button.setAttribute("aria-keyshortcuts", keys[index]);
        if (keys[index] !== labels[index]) {
          button.append(Object.assign(document.createElement("kbd"), { textContent: keys[index], ariaHidden: "true" }));
        }
        this.byKey.set(keys[index], (event) => this.onAnswer(answer, event));
      }
      button.addEventListener("click", (event) => this.onAnswer(answer, event));
      this.group.append(button);
    });
    if (again) {
      this.byKey.set(AGAIN_KEY, this.onAgain);
    }
  }

  #confirm(event) {
    if (this.confirm.getAttribute("aria-disabled") === "false") {
      this.onAnswer(this.kind === "number" ? readNumber(this.number.value) : Number(this.magnitude.value), event);
    }
  }

  #chooseNumber() {
    const number = readNumber(this.number.value);
    this.confirm.setAttribute("aria-disabled", !(number > 0 && number < NUMBER_MAX));
  }

  #chooseMagnitude() {
    this.value.textContent = Number(this.magnitude.value).toFixed(2);
    this.confirm.setAttribute("aria-disabled", "false");
  }

  #onKey(event) {
    const isOther = event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input:not([type=checkbox]), select");
    const act = this.byKey.get(event.key.toLowerCase());
    if (this.keys.checked && !isOther && act) {
      act(event);
    }
  }
}
