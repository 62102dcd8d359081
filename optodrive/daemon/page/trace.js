// Height and temperature of the picked pixel over the last ten seconds.

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { themed } from "./colours.js";

const BACK_S = 10;
const HEIGHT = 170;

export class Trace {
  constructor(box) {
    this.box = box;
    this.forget();
    this.themed();
    new ResizeObserver(() => this.plot.setSize({ width: Math.max(100, box.clientWidth), height: HEIGHT })).observe(box);
  }

  forget() {
    this.t = [];
    this.height = [];
    this.absorber = [];
  }

  themed() {
    this.plot?.destroy();
    const [ink, line] = [themed("soft"), themed("line")];
    const axis = { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, font: "11px system-ui" };
    const options = {
      width: Math.max(100, this.box.clientWidth),
      height: HEIGHT,
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: [-BACK_S, 0] }, um: { range: (u, low, high) => [0, Math.max(10, high * 1.1)] }, c: { range: (u, low, high) => [Math.min(20, low), Math.max(40, high * 1.05)] } },
      axes: [
        { ...axis, values: (u, ticks) => ticks.map((tick) => `${tick} s`) },
        { ...axis, scale: "um", size: 58, stroke: themed("accent"), values: (u, ticks) => ticks.map((tick) => `${tick} µm`) },
        { ...axis, scale: "c", side: 1, size: 58, stroke: themed("bad"), grid: { show: false }, values: (u, ticks) => ticks.map((tick) => `${tick} °C`) },
      ],
      series: [
        {},
        { scale: "um", stroke: themed("accent"), width: 2, points: { show: false } },
        { scale: "c", stroke: themed("bad"), width: 1.5, dash: [4, 3], points: { show: false } },
      ],
    };
    this.plot = new uPlot(options, [[], [], []], this.box);
  }

  add(boardS, heightUm, celsius) {
    if (this.t.length && boardS < this.t.at(-1)) {
      this.forget();
    }
    this.t.push(boardS);
    this.height.push(heightUm);
    this.absorber.push(celsius);
    const from = this.t.findIndex((s) => s > boardS - BACK_S);
    for (const column of [this.t, this.height, this.absorber]) {
      column.splice(0, from);
    }
  }

  paint() {
    const now = this.t.at(-1) ?? 0;
    this.plot.setData([this.t.map((s) => s - now), this.height, this.absorber]);
  }
}
