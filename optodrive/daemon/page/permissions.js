// The caller: the name and role of its token, and the controls that the role may not use, each with the reason.
// A control states its route in data-route of a fieldset around it; the daemon states which routes it refuses.

import { call } from "./api.js";

export class Permissions {
  constructor(find) {
    this.label = find("caller");
    this.caller = null;
    this.reasons = new WeakMap();
    addEventListener("refused", () => this.load());
  }

  // Ask the daemon who the caller is; its tokens may have changed.
  async load() {
    try {
      this.caller = await call("GET", "/v1/me");
    } catch {
      return; // the next connection asks again; the daemon checks every request in any case
    }
    const { name, role } = this.caller;
    this.label.textContent = name === role ? role : `${name}, ${role}`;
    this.label.title = `This page uses the token “${name}” of role ${role}.`;
    this.apply();
  }

  // Disable everything: the daemon does not know the token.
  refuse() {
    this.caller = null;
    this.label.textContent = "token not valid";
    this.label.title = "";
    this.apply();
    for (const controls of document.querySelectorAll("[data-route]")) {
      controls.disabled = true;
    }
  }

  // Disable what the role may not use; again after a control has been added.
  apply() {
    const { caller } = this;
    for (const controls of document.querySelectorAll("[data-route]")) {
      const required = caller?.refused[controls.dataset.route];
      controls.disabled = required !== undefined;
      const reason = this.reasons.get(controls) ?? this.#createReason(controls);
      reason.hidden = !controls.disabled;
      reason.textContent = required ? `${controls.dataset.action} needs the role ${required}; token “${caller.name}” has the role ${caller.role}.` : "";
    }
  }

  // The reason stands below the row of its controls.
  #createReason(controls) {
    const reason = Object.assign(document.createElement("p"), { className: "reason" });
    controls.parentElement.append(reason);
    this.reasons.set(controls, reason);
    return reason;
  }
}
