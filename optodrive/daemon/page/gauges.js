// Budgets as gauges: how much of each cap is used, by the limiter's own bound on what was executed.

import { CAPS } from "./plans.js";

export class Gauges {
  constructor(box) {
    this.box = box;
    this.each = new Map();
  }

  show(caps) {
    for (const cap of caps) {
      const gauge = this.each.get(cap.cap) ?? this.#make(cap);
      const at = cap.pixel !== null && cap.fraction > 0.5 ? `, pixel ${cap.pixel}` : "";
      const [thousand, k] = cap.limit >= 1e4 ? [1000, "k"] : [1, ""];
      const limit = cap.limit / thousand;
      const digits = Math.max(0, 2 - Math.floor(Math.log10(limit)));
      const text = `${(cap.value / thousand).toFixed(digits)} of ${limit.toFixed(digits)} ${k}${cap.unit}${at}`;
      gauge.text.textContent = text;
      gauge.bar.style.setProperty("--fraction", Math.min(1, Math.max(0, cap.fraction)));
      gauge.item.dataset.kind = cap.fraction > 0.95 ? "bad" : cap.fraction > 0.8 ? "warn" : "";
      gauge.bar.setAttribute("aria-valuenow", Math.round(100 * Math.max(0, Math.min(1, cap.fraction))));
      gauge.bar.setAttribute("aria-valuetext", text);
    }
  }

  #make(cap) {
    const item = Object.assign(document.createElement("div"), { className: "gauge" });
    const name = Object.assign(document.createElement("b"), { textContent: CAPS[cap.cap] ?? cap.cap });
    const text = document.createElement("span");
    const bar = document.createElement("i");
    for (const [key, value] of Object.entries({ role: "meter", "aria-valuemin": 0, "aria-valuemax": 100, "aria-label": name.textContent })) {
      bar.setAttribute(key, value);
    }
    item.append(name, text, bar);
    this.box.append(item);
    const gauge = { item, text, bar };
    this.each.set(cap.cap, gauge);
    return gauge;
  }
}
