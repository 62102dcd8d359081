// The time line: pulses as planned and as executed, a few seconds back and one ahead, and what the limiter took away.

import { themed } from "./colours.js";
import { CAPS } from "./plans.js";

const BACK_S = 4;
const AHEAD_S = 1;
const KEPT_S = 6;
const LIT_KEPT = 400;

export class Timeline {
  constructor(canvas, text, powerMaxW) {
    this.canvas = canvas;
    this.text = text;
    this.powerMaxW = powerMaxW;
    this.pulses = new Map();
    this.lit = [];
    this.board = { s: 0, at: performance.now() };
    this.themed();
    new ResizeObserver(() => this.#fit()).observe(canvas);
  }

  themed() {
    this.colour = { executed: themed("accent"), trimmed: themed("bad"), line: themed("line"), ink: themed("soft") };
  }

  nowS() {
    return this.board.s + (performance.now() - this.board.at) / 1000;
  }

  take({ board_s, planned, executed }) {
    this.board = { s: board_s, at: performance.now() };
    for (const [done, batches] of [[false, planned], [true, executed]]) {
      for (const batch of batches) {
        batch.row.forEach((row, k) => {
          const key = `${batch.plan}/${row}`;
          if (done || !this.pulses.get(key)?.done) {
            const pulse = { done, plan: batch.plan, pixel: batch.pixel[k], start: batch.start_s[k], width: batch.width_s[k] };
            pulse.power = batch.power_w[k];
            pulse.taken = batch.trimmed_j[k] / Math.max(batch.width_s[k], 1e-6);
            pulse.reason = batch.reason[k];
            this.pulses.set(key, pulse);
            if (done && pulse.power > 0) {
              this.lit.push(pulse);
            }
          }
        });
      }
    }
    this.lit.splice(0, this.lit.length - LIT_KEPT);
    const oldest = this.nowS() - KEPT_S;
    // They came in order of time, near enough: the first that is young ends the search.
    for (const [key, pulse] of this.pulses) {
      if (pulse.start >= oldest) {
        break;
      }
      this.pulses.delete(key);
    }
  }

  // Another daemon may count time from another zero, and its plans from one.
  forget() {
    this.pulses.clear();
    this.lit = [];
  }

  // The pixels that were lit last, the newest at the end.
  path(seconds = 0.6, most = 40) {
    const since = this.nowS() - seconds;
    return this.lit.slice(-most).filter((pulse) => pulse.start > since).map((pulse) => pulse.pixel);
  }

  #fit() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.paint();
  }

  paint() {
    const { canvas, colour } = this;
    const context = canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.width, canvas.height];
    const base = height - 18 * ratio;
    const now = this.nowS();
    const x = (s) => ((s - now + BACK_S) / (BACK_S + AHEAD_S)) * width;
    const y = (w) => (Math.min(w, this.powerMaxW * 1.15) / (this.powerMaxW * 1.2)) * base;
    context.clearRect(0, 0, width, height);
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.fillStyle = colour.ink;
    context.strokeStyle = colour.line;
    context.lineWidth = ratio;
    for (let back = -BACK_S; back <= AHEAD_S; back++) {
      const at = Math.round(x(now + back));
      context.beginPath();
      context.moveTo(at, 0);
      context.lineTo(at, base);
      context.stroke();
      context.textAlign = back === -BACK_S ? "left" : back === AHEAD_S ? "right" : "center";
      context.fillText(back === 0 ? "now" : `${back > 0 ? "+" : "−"}${Math.abs(back)} s`, at, height - 5 * ratio);
    }
    context.textAlign = "left";
    context.fillText(`${this.powerMaxW} W`, 4 * ratio, base - y(this.powerMaxW) + 4 * ratio);
    // All of one kind at once: there may be thousands.
    const [executed, planned, taken] = [new Path2D(), new Path2D(), new Path2D()];
    for (const pulse of this.pulses.values()) {
      const left = x(pulse.start);
      const wide = Math.max(ratio, x(pulse.start + pulse.width) - left);
      const high = y(pulse.power);
      (pulse.done ? executed : planned).rect(left, base - high, wide, high);
      if (pulse.taken > 0) {
        const more = Math.max(2 * ratio, y(pulse.power + pulse.taken) - high);
        taken.rect(left, base - high - more, wide, more);
      }
    }
    context.strokeStyle = context.fillStyle = colour.executed;
    context.stroke(planned);
    context.fill(executed);
    context.fillStyle = colour.trimmed;
    context.fill(taken);
    context.strokeStyle = colour.ink;
    context.lineWidth = 2 * ratio;
    context.strokeRect(x(now), 0, 0, base);
  }

  describe() {
    const now = this.nowS();
    const lately = [...this.pulses.values()].filter((pulse) => pulse.start > now - BACK_S && pulse.start <= now);
    const done = lately.filter((pulse) => pulse.done);
    const trimmed = done.filter((pulse) => pulse.taken > 0);
    const reasons = [...new Set(trimmed.map((pulse) => CAPS[pulse.reason] ?? pulse.reason))];
    const why = trimmed.length ? `, ${trimmed.length} of them trimmed (${reasons.join(", ")})` : ", none trimmed";
    const next = [...this.pulses.values()].filter((pulse) => pulse.start > now).length;
    const text = done.length ? `In the last ${BACK_S} s ${done.length} pulses were executed${why}. ` : "No pulses lately. ";
    this.text.textContent = text + (next ? `${next} come within the next second.` : "");
  }
}
