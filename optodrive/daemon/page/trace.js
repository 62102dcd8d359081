// Height and temperature of the selected pixel over the last ten seconds: the peaks between two messages.

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { readThemeColour } from "./colours.js";

const HISTORY_S = 10;
const HEIGHT = 170;

export class Trace {
  constructor(container) {
    this.container = container;
    this.clear();
    this.applyTheme();
    const fit = () => this.plot.setSize({ width: Math.max(100, container.clientWidth), height: HEIGHT });
    new ResizeObserver(fit).observe(container);
  }

  clear() {
    this.t = [];
    this.height = [];
    this.absorber = [];
  }

  applyTheme() {
    this.plot?.destroy();
    const [ink, line, accent, bad] = ["soft", "line", "accent", "bad"].map(readThemeColour);
    const axis = { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, font: "11px system-ui" };
    const options = {
      width: Math.max(100, this.container.clientWidth),
      height: HEIGHT,
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { time: false, range: [-HISTORY_S, 0] },
        um: { range: (u, low, high) => [0, Math.max(10, high * 1.1)] },
        c: { range: (u, low, high) => [Math.min(20, low), Math.max(40, high * 1.05)] },
      },
      axes: [
        { ...axis, values: (u, ticks) => ticks.map((tick) => `${tick} s`) },
        { ...axis, scale: "um", size: 58, stroke: accent, values: (u, ticks) => ticks.map((tick) => `${tick} µm`) },
        { ...axis, scale: "c", side: 1, size: 58, stroke: bad, grid: { show: false }, values: (u, ticks) => ticks.map((tick) => `${tick} °C`) },
      ],
      series: [
        {},
        { scale: "um", stroke: accent, width: 2, points: { show: false } },
        { scale: "c", stroke: bad, width: 1.5, dash: [4, 3], points: { show: false } },
      ],
    };
    this.plot = new uPlot(options, [[], [], []], this.container);
  }

  // The highest displacement and temperature of the last ten seconds, µm and °C; null without any.
  get peaks() {
    return this.t.length ? [Math.max(...this.height), Math.max(...this.absorber)] : null;
  }

  // heightUm, absorberC: the highest since the last call
  add(boardS, heightUm, absorberC) {
    if (this.t.length && boardS < this.t.at(-1)) {
      this.clear();
    }
    this.t.push(boardS);
    this.height.push(heightUm);
    this.absorber.push(absorberC);
    const first = this.t.findIndex((s) => s > boardS - HISTORY_S);
    for (const column of [this.t, this.height, this.absorber]) {
      column.splice(0, first);
    }
  }

  paint() {
    const now = this.t.at(-1) ?? 0;
    this.plot.setData([this.t.map((s) => s - now), this.height, this.absorber]);
  }
}

// Peaks of every pixel between two updates of the texts: a bump may be over between two messages.
export class Peaks {
  constructor(pixels) {
    const none = () => ({ height: new Float32Array(pixels), absorber: new Float32Array(pixels) });
    [this.newest, this.shown, this.next] = [none(), none(), null];
  }

  // height, absorber: the highest since the last call, µm and °C
  add(height, absorber) {
    this.newest = { height, absorber };
    const max = (name) => this.next?.[name].map((value, pixel) => Math.max(value, this.newest[name][pixel])) ?? this.newest[name];
    this.next = { height: max("height"), absorber: max("absorber") };
  }

  // Return the peaks since the last call, or the last ones if none have come since.
  take() {
    this.shown = this.next ?? this.shown;
    this.next = null;
    return this.shown;
  }

  newestOf(pixel) {
    return [this.newest.height[pixel], this.newest.absorber[pixel]];
  }

  // Return the highest of a pixel since the update before the last one, µm and °C.
  of(pixel) {
    const since = [this.shown, this.next ?? this.shown];
    return ["height", "absorber"].map((name) => Math.max(...since.map((each) => each[name][pixel])));
  }
}
