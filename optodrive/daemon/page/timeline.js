// Time line: planned and executed pulses of the last seconds and the next one, and the energy that the limiter trimmed.

import { labelCap } from "./caps.js";
import { readThemeColour } from "./colours.js";

const HISTORY_S = 4;
const AHEAD_S = 1;
const RETENTION_S = 6;
const RESTART_S = 0.5; // a time that much before the last one is of a clock that began anew
const BEAM_PULSES_MAX = 400;
const OUTLINE_MIN_PX = 5; // a narrower pulse has only the upper edge of its outline, because the sides would fill it

export class Timeline {
  constructor(canvas, text, maxPowerW) {
    this.canvas = canvas;
    this.text = text;
    this.maxPowerW = maxPowerW;
    this.pulses = new Map();
    this.beamPulses = [];
    this.board = { s: -Infinity, at: performance.now() };
    this.applyTheme();
    new ResizeObserver(() => this.#fit()).observe(canvas);
  }

  applyTheme() {
    const read = readThemeColour;
    this.colour = { executed: read("accent"), trimmed: read("bad"), line: read("line"), ink: read("soft") };
  }

  nowS() {
    return this.board.s + (performance.now() - this.board.at) / 1000;
  }

  // Take the present time of the board. Pulses of a clock that began anew since are no longer in time.
  setTime(boardS) {
    if (boardS < this.board.s - RESTART_S) {
      this.clear();
    }
    this.board = { s: boardS, at: performance.now() };
  }

  // board_s: time of the newest pulses, which may be long past for a new reader
  addPulses({ board_s, planned, executed }) {
    if (board_s > this.nowS()) {
      this.setTime(board_s);
    }
    for (const [isExecuted, batches] of [[false, planned], [true, executed]]) {
      for (const batch of batches) {
        batch.row.forEach((row, k) => {
          const key = `${batch.plan}/${row}`;
          if (isExecuted || !this.pulses.get(key)?.isExecuted) {
            const pulse = {
              isExecuted,
              pixel: batch.pixel[k],
              startS: batch.start_s[k],
              widthS: batch.width_s[k],
              powerW: batch.power_w[k],
              trimmedW: batch.trimmed_j[k] / Math.max(batch.width_s[k], 1e-6),
              reason: batch.reason[k],
            };
            this.pulses.set(key, pulse);
            if (isExecuted && pulse.powerW > 0) {
              this.beamPulses.push(pulse);
            }
          }
        });
      }
    }
    this.beamPulses.splice(0, this.beamPulses.length - BEAM_PULSES_MAX);
    const oldestS = this.nowS() - RETENTION_S;
    // The pulses are nearly in order of time: the first recent one ends the search.
    for (const [key, pulse] of this.pulses) {
      if (pulse.startS >= oldestS) {
        break;
      }
      this.pulses.delete(key);
    }
  }

  // Remove all pulses: a restarted daemon counts time and plans anew.
  clear() {
    this.pulses.clear();
    this.beamPulses = [];
    this.board = { s: -Infinity, at: performance.now() };
  }

  // Remove the pulses that were planned and will not come.
  dropPlanned() {
    for (const [key, pulse] of this.pulses) {
      if (!pulse.isExecuted) {
        this.pulses.delete(key);
      }
    }
  }

  // Return the pixels of the latest executed pulses, the newest last.
  beamPath(seconds = 0.6, maxCount = 40) {
    const sinceS = this.nowS() - seconds;
    return this.beamPulses.slice(-maxCount).filter((pulse) => pulse.startS > sinceS).map((pulse) => pulse.pixel);
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
    const x = (s) => ((s - now + HISTORY_S) / (HISTORY_S + AHEAD_S)) * width;
    const y = (w) => (Math.min(w, this.maxPowerW * 1.15) / (this.maxPowerW * 1.2)) * base;
    context.clearRect(0, 0, width, height);
    context.font = `${11 * ratio}px system-ui, sans-serif`;
    context.fillStyle = colour.ink;
    context.strokeStyle = colour.line;
    context.lineWidth = ratio;
    for (let offsetS = -HISTORY_S; offsetS <= AHEAD_S; offsetS++) {
      const at = Math.round(x(now + offsetS));
      context.beginPath();
      context.moveTo(at, 0);
      context.lineTo(at, base);
      context.stroke();
      context.textAlign = offsetS === -HISTORY_S ? "left" : offsetS === AHEAD_S ? "right" : "center";
      context.fillText(offsetS === 0 ? "now" : `${offsetS > 0 ? "+" : "−"}${Math.abs(offsetS)} s`, at, height - 5 * ratio);
    }
    context.textAlign = "left";
    context.fillText(`${this.maxPowerW} W`, 4 * ratio, base - y(this.maxPowerW) + 4 * ratio);
    // One path per kind, because there may be thousands of pulses.
    const [executed, planned, trimmed] = [new Path2D(), new Path2D(), new Path2D()];
    for (const pulse of this.pulses.values()) {
      const left = x(pulse.startS);
      const barWidth = Math.max(ratio, x(pulse.startS + pulse.widthS) - left);
      const barHeight = y(pulse.powerW);
      if (pulse.isExecuted) {
        executed.rect(left, base - barHeight, barWidth, barHeight);
      } else if (barWidth >= OUTLINE_MIN_PX * ratio) {
        planned.rect(left, base - barHeight, barWidth, barHeight);
      } else {
        planned.moveTo(left, base - barHeight);
        planned.lineTo(left + barWidth, base - barHeight);
      }
      if (pulse.trimmedW > 0) {
        const trimmedHeight = Math.max(2 * ratio, y(pulse.powerW + pulse.trimmedW) - barHeight);
        trimmed.rect(left, base - barHeight - trimmedHeight, barWidth, trimmedHeight);
      }
    }
    context.strokeStyle = context.fillStyle = colour.executed;
    context.stroke(planned);
    context.fill(executed);
    context.fillStyle = colour.trimmed;
    context.fill(trimmed);
    context.strokeStyle = colour.ink;
    context.lineWidth = 2 * ratio;
    context.strokeRect(x(now), 0, 0, base);
  }

  // mayPlay: whether planned pulses are going to start
  describe(mayPlay = true) {
    const now = this.nowS();
    const pulses = [...this.pulses.values()];
    const executed = pulses.filter((pulse) => pulse.isExecuted && pulse.startS > now - HISTORY_S);
    const trimmed = executed.filter((pulse) => pulse.trimmedW > 0);
    const reasons = [...new Set(trimmed.map((pulse) => labelCap(pulse.reason)))];
    const trimming = trimmed.length ? `, ${trimmed.length} of them trimmed (${reasons.join(", ")})` : ", none trimmed";
    const isUpcoming = ({ isExecuted, startS }) => !isExecuted && startS > now && startS <= now + AHEAD_S;
    const upcoming = mayPlay ? pulses.filter(isUpcoming).length : 0;
    const count = executed.length === 1 ? "1 pulse was" : `${executed.length} pulses were`;
    const text = executed.length ? `In the last ${HISTORY_S} s ${count} executed${trimming}. ` : `No pulse in the last ${HISTORY_S} s. `;
    this.text.textContent = text + (upcoming ? `${upcoming} ${upcoming === 1 ? "starts" : "start"} within the next second.` : "");
  }
}
