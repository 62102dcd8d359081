// Gauges of the used fraction of each cap, by the limiter's bound on the executed pulses.

import { labelCap } from "./caps.js";

const LEVELS = [
  { fraction: 0.95, kind: "bad" },
  { fraction: 0.8, kind: "warn" },
];

export class Gauges {
  constructor(container) {
    this.container = container;
    this.gauges = new Map();
  }

  show(caps) {
    for (const cap of caps) {
      const gauge = this.gauges.get(cap.cap) ?? this.#create(cap);
      const place = cap.pixel !== null && cap.fraction > 0.5 ? `, pixel ${cap.pixel}` : "";
      const [divisor, prefix] = cap.limit >= 1e4 ? [1000, "k"] : [1, ""];
      const limit = cap.limit / divisor;
      const digits = Math.max(0, 2 - Math.floor(Math.log10(limit)));
      const text = `${(cap.value / divisor).toFixed(digits)} of ${limit.toFixed(digits)} ${prefix}${cap.unit}${place}`;
      gauge.text.textContent = text;
      gauge.bar.style.setProperty("--fraction", Math.min(1, Math.max(0, cap.fraction)));
      const level = LEVELS.find(({ fraction }) => cap.fraction >= fraction);
      gauge.item.dataset.kind = level?.kind ?? "";
      gauge.level.textContent = level ? `▲ ≥ ${100 * level.fraction} %` : "";
      gauge.bar.setAttribute("aria-valuenow", Math.round(100 * Math.max(0, Math.min(1, cap.fraction))));
      gauge.bar.setAttribute("aria-valuetext", text);
    }
  }

  #create(cap) {
    const item = Object.assign(document.createElement("div"), { className: "gauge" });
    const name = Object.assign(document.createElement("b"), { textContent: labelCap(cap.cap) });
    const level = document.createElement("em");
    const text = document.createElement("span");
    const bar = document.createElement("i");
    for (const [key, value] of Object.entries({ role: "meter", "aria-valuemin": 0, "aria-valuemax": 100, "aria-label": name.textContent })) {
      bar.setAttribute(key, value);
    }
    item.append(name, level, text, bar);
    this.container.append(item);
    const gauge = { item, level, text, bar };
    this.gauges.set(cap.cap, gauge);
    return gauge;
  }
}
