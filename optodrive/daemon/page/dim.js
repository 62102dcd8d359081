// The largest power of a pulse as a share of the laser's: a slider, and a mark in the header while it is dimmed.

import { call } from "./api.js";

const RAISING_ROLE = "armer"; // any role that may dim may lower it

export class DimControl {
  // maxShare: as configured; getCaller(): the name and role of this page's token, null if they are unknown
  constructor(find, maxShare, getCaller, announce, onError) {
    this.slider = find("dim");
    this.slider.max = Math.floor(maxShare * 100);
    this.value = find("dim-value");
    this.note = find("dim-note");
    this.mark = find("dimmed");
    this.getCaller = getCaller;
    this.announce = announce;
    this.onError = onError;
    this.share = null;
    this.isChosen = false; // a value is being chosen, or sent
    this.slider.addEventListener("input", () => this.#choose());
    this.slider.addEventListener("change", () => this.#send());
    this.slider.addEventListener("blur", () => (this.isChosen = false));
    this.show(null);
  }

  // Show the share in force; null if it is unknown.
  show(share) {
    this.share = share;
    this.slider.disabled = share === null;
    this.mark.hidden = share === null || share >= 1;
    this.mark.textContent = share === null ? "" : `≤ ${format(share)}`;
    if (!this.isChosen) {
      this.#showValue(share);
    }
  }

  #showValue(share) {
    this.slider.value = share === null ? this.slider.max : Math.round(share * 100);
    this.value.textContent = share === null ? "unknown" : format(share);
    this.note.hidden = share === null || share >= 1;
    this.note.textContent = "Applies from the next plan on.";
  }

  #choose() {
    this.isChosen = true;
    const share = Number(this.slider.value) / 100;
    this.#showValue(share);
    if (share > this.share && this.getCaller()?.role !== RAISING_ROLE) {
      this.#showValue(this.share);
      this.note.hidden = false;
      this.note.textContent = `Raising the power needs the role ${RAISING_ROLE}.`;
      this.announce(this.note.textContent);
    }
  }

  async #send() {
    const share = Number(this.slider.value) / 100;
    if (Math.abs(share - this.share) > 1e-9) {
      try {
        const state = await call("PUT", "/v1/dim", { body: { share } });
        this.announce(`Maximum power ${format(share)}.`);
        this.share = state.limits.power_share;
      } catch (error) {
        this.onError(error);
      }
    }
    this.isChosen = false;
    if (this.share !== null && share !== this.share) {
      this.#showValue(this.share);
    }
  }
}

function format(share) {
  return `${Math.round(share * 100)} %`;
}
