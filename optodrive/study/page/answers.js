// The answers of a study as buttons and keys, or a scale for a magnitude.

const AGAIN_KEY = "0";
const POSITIONS = "123456789abcdefghijklmnopqrstuvwxyz";

// Return the key of each answer: its first letter or digit if these differ from each other, else its position.
export function assignKeys(answers) {
  const firsts = answers.map((answer) => answer[0].toLowerCase());
  const isUsable = firsts.every((key) => /^[a-z1-9]$/.test(key)) && new Set(firsts).size === firsts.length;
  return answers.map((_, index) => (isUsable ? firsts[index] : POSITIONS[index] ?? ""));
}

export class Answers {
  // find: returns the element with an id; onAnswer: gets an answer and the event that gave it; onAgain: gets its event
  constructor(find, onAnswer, onAgain) {
    this.group = find("answers");
    this.scale = find("scale");
    this.magnitude = find("magnitude");
    this.value = find("value");
    this.confirm = find("confirm");
    this.again = find("again");
    this.keys = find("keys");
    this.onAnswer = onAnswer;
    this.onAgain = onAgain;
    this.shown = "";
    this.byKey = new Map();
    this.magnitude.addEventListener("input", () => this.#chooseMagnitude());
    this.confirm.addEventListener("click", (event) => {
      if (this.confirm.getAttribute("aria-disabled") === "false") {
        onAnswer(Number(this.magnitude.value), event);
      }
    });
    this.again.addEventListener("click", onAgain);
    addEventListener("keydown", (event) => this.#onKey(event));
  }

  // Show the answers of a study; isAccepted: whether they are about a stimulus now.
  show({ kind, answers }, isAccepted) {
    const shown = JSON.stringify([kind, answers]);
    if (this.shown !== shown) {
      this.shown = shown;
      this.group.hidden = kind !== "choice";
      this.scale.hidden = kind !== "magnitude";
      this.#buildButtons(answers);
    }
    this.isAccepted = isAccepted;
    for (const button of [...this.group.children, this.again]) {
      button.setAttribute("aria-disabled", !isAccepted);
    }
  }

  // Forget the magnitude of the trial before.
  reset() {
    this.magnitude.value = 0.5;
    this.value.textContent = "no answer yet";
    this.confirm.setAttribute("aria-disabled", "true");
  }

  #buildButtons(answers) {
    const keys = assignKeys(answers);
    this.group.dataset.count = answers.length;
    this.group.replaceChildren();
    this.byKey.clear();
    answers.forEach((answer, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = answer;
      if (keys[index]) {
        button.setAttribute("aria-keyshortcuts", keys[index]);
        if (keys[index] !== answer) {
          button.append(Object.assign(document.createElement("kbd"), { textContent: keys[index], ariaHidden: "true" }));
        }
        this.byKey.set(keys[index], (event) => this.onAnswer(answer, event));
      }
      button.addEventListener("click", (event) => this.onAnswer(answer, event));
      this.group.append(button);
    });
    this.byKey.set(AGAIN_KEY, this.onAgain);
  }

  #chooseMagnitude() {
    this.value.textContent = Number(this.magnitude.value).toFixed(2);
    this.confirm.setAttribute("aria-disabled", "false");
  }

  #onKey(event) {
    const isOther = event.repeat || event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input[type=range]");
    const act = this.byKey.get(event.key.toLowerCase());
    if (this.keys.checked && !isOther && act) {
      act(event);
    }
  }
}
