// Pattern library: every pattern of the daemon, with a field per parameter.

export class PatternLibrary extends EventTarget {
  constructor(find, patterns, getSelectedPixel) {
    super();
    this.patterns = new Map(patterns.map((pattern) => [pattern.name, pattern]));
    this.select = find("pattern");
    this.notes = find("pattern-notes");
    this.container = find("parameters");
    this.getSelectedPixel = getSelectedPixel;
    for (const name of this.patterns.keys()) {
      this.select.append(new Option(name));
    }
    this.select.addEventListener("change", () => {
      document.querySelector(`input[name="policy"][value="${this.patterns.get(this.name).policy}"]`).checked = true;
      this.#showFields();
    });
    this.container.addEventListener("input", () => this.dispatchEvent(new Event("changed")));
    this.select.selectedIndex = 0;
    this.#showFields();
  }

  get name() {
    return this.select.value;
  }

  #showFields() {
    const pattern = this.patterns.get(this.name);
    this.notes.textContent = `${pattern.summary}. ${pattern.notes}`;
    this.fields = new Map(pattern.parameters.map((parameter) => [parameter, createField(parameter)]));
    this.container.replaceChildren(...[...this.fields].map(([parameter, field]) => this.#createLabel(parameter, field)));
    this.dispatchEvent(new Event("changed"));
  }

  #createLabel(parameter, field) {
    const label = document.createElement("label");
    const unit = parameter.unit ? `, ${parameter.unit}` : "";
    const text = parameter.name.replace(/_(um|mm|s|hz)$/, "").replaceAll("_", " ");
    label.append(`${text}${unit}${parameter.required ? " (required)" : ""}`, field);
    label.title = parameter.description;
    if (parameter.kind === "pixel") {
      field.addEventListener("focus", () => {
        field.placeholder = `${parameter.default ?? "middle"}; selected: ${this.getSelectedPixel()}`;
      });
    }
    return label;
  }

  // Return the parameters that are filled in, in the form of the request.
  async readValues() {
    const values = {};
    for (const [parameter, field] of this.fields) {
      if (parameter.kind === "flag") {
        values[parameter.name] = field.checked;
      } else if (parameter.kind === "file") {
        if (field.files[0]) {
          values[parameter.name] = await encodeBase64(field.files[0]);
        }
      } else if (field.value !== "") {
        const isNumber = ["number", "integer", "pixel"].includes(parameter.kind);
        values[parameter.name] = isNumber ? Number(field.value) : field.value;
      }
    }
    return values;
  }
}

function createField(parameter) {
  if (parameter.kind === "choice") {
    // A list instead of a dropdown, which would take Escape from STOP.
    const select = Object.assign(document.createElement("select"), { size: Math.max(2, parameter.choices.length) });
    select.append(...parameter.choices.map((choice) => new Option(choice, choice, false, choice === parameter.default)));
    return select;
  }
  const field = document.createElement("input");
  field.autocomplete = "off"; // suggestions of the browser would take Escape from STOP
  field.type = { flag: "checkbox", text: "text", file: "file" }[parameter.kind] ?? "number";
  if (field.type === "number") {
    field.step = parameter.kind === "number" ? "any" : "1";
    field.min = parameter.min ?? 0;
    if (parameter.max !== null) {
      field.max = parameter.max;
    }
    field.placeholder = parameter.default ?? (parameter.kind === "pixel" ? "middle" : "");
  }
  if (parameter.kind === "flag") {
    field.checked = Boolean(parameter.default);
  }
  return field;
}

async function encodeBase64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) {
    text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  }
  return btoa(text);
}
