// The library: every pattern the daemon knows, with a field for each of its parameters.

export class Library extends EventTarget {
  constructor(find, patterns, picked) {
    super();
    this.patterns = new Map(patterns.map((pattern) => [pattern.name, pattern]));
    this.select = find("pattern");
    this.notes = find("pattern-notes");
    this.fields = find("parameters");
    this.picked = picked;
    for (const name of this.patterns.keys()) {
      this.select.append(new Option(name));
    }
    this.select.addEventListener("change", () => this.#choose());
    this.fields.addEventListener("input", () => this.dispatchEvent(new Event("changed")));
    this.#choose();
  }

  get name() {
    return this.select.value;
  }

  #choose() {
    const pattern = this.patterns.get(this.name);
    this.notes.textContent = `${pattern.summary}. ${pattern.notes}`;
    this.inputs = new Map(pattern.parameters.map((parameter) => [parameter, input(parameter)]));
    this.fields.replaceChildren(...[...this.inputs].map(([parameter, field]) => this.#labelled(parameter, field)));
    this.dispatchEvent(new Event("changed"));
  }

  #labelled(parameter, field) {
    const label = document.createElement("label");
    const unit = parameter.unit ? `, ${parameter.unit}` : "";
    const words = parameter.name.replace(/_(um|mm|s|hz)$/, "").replaceAll("_", " ");
    label.append(`${words}${unit}${parameter.required ? " (needed)" : ""}`, field);
    label.title = parameter.description;
    if (parameter.kind === "pixel") {
      field.addEventListener("focus", () => (field.placeholder = `${parameter.default ?? "middle"}; picked: ${this.picked()}`));
    }
    return label;
  }

  // What is filled in, as the daemon takes it.
  async values() {
    const given = {};
    for (const [parameter, field] of this.inputs) {
      if (parameter.kind === "flag") {
        given[parameter.name] = field.checked;
      } else if (parameter.kind === "file") {
        if (field.files[0]) {
          given[parameter.name] = await base64(field.files[0]);
        }
      } else if (field.value !== "") {
        given[parameter.name] = ["number", "integer", "pixel"].includes(parameter.kind) ? Number(field.value) : field.value;
      }
    }
    return given;
  }
}

function input(parameter) {
  if (parameter.kind === "choice") {
    const select = document.createElement("select");
    select.append(...parameter.choices.map((choice) => new Option(choice, choice, false, choice === parameter.default)));
    return select;
  }
  const field = document.createElement("input");
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

async function base64(file) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) {
    text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  }
  return btoa(text);
}
