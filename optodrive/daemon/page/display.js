// The display: every pixel a square, what is drawn and the beam's path over it. One picture of the lattice is scaled up.

import { table, themed } from "./colours.js";

const SIZE = 680;
const STEPS = [10, 20, 50, 100, 200, 500, 1000];
const SHRINK_MS = 3000;
const GAP = 0.12;

export class DisplayView {
  constructor(canvas, grid) {
    this.canvas = canvas;
    this.grid = grid;
    this.show = "height";
    this.cursor = grid.middle();
    this.drawn = new Float32Array(grid.pixels);
    this.beam = [];
    this.live = false;
    this.values = { height: new Float32Array(grid.pixels), absorber: new Float32Array(grid.pixels), preview: new Float32Array(grid.pixels) };
    this.ambient = 20;
    this.top = { height: 10, absorber: 10, preview: 10 };
    this.small = new Map();
    this.frames = 0;
    this.cell = SIZE / Math.max(grid.rows, grid.columns);
    canvas.width = Math.round(this.cell * grid.columns);
    canvas.height = Math.round(this.cell * grid.rows);
    canvas.style.aspectRatio = `${grid.columns} / ${grid.rows}`;
    this.context = canvas.getContext("2d", { alpha: false });
    this.lattice = new OffscreenCanvas(grid.columns, grid.rows);
    this.picture = new ImageData(grid.columns, grid.rows);
    this.mask = new OffscreenCanvas(canvas.width, canvas.height);
    this.marks = new OffscreenCanvas(canvas.width, canvas.height);
    this.setColours("viridis");
    this.asked = false;
    this.rescaled = () => {};
  }

  setColours(name) {
    this.colours = table(name);
    this.themed();
  }

  // Colours of the theme, and all that depends on them.
  themed() {
    this.ink = themed("ink");
    this.mark = themed("mark");
    this.#paintMask(themed("well"));
    this.redrawMarks();
  }

  // What came from the daemon; values in µm and °C.
  take(height, absorber) {
    this.values.height = height;
    this.values.absorber = absorber;
    this.ask();
  }

  ask() {
    if (!this.asked) {
      this.asked = true;
      requestAnimationFrame(() => this.paint());
    }
  }

  get low() {
    return this.show === "absorber" ? this.ambient : 0;
  }

  paint() {
    this.asked = false;
    const { grid, context, picture, colours } = this;
    const values = this.values[this.show];
    const top = this.#scale(values);
    const bytes = picture.data;
    for (let pixel = 0; pixel < grid.pixels; pixel++) {
      const place = grid.place[pixel];
      const row = grid.rows - 1 - Math.floor(place / grid.columns);
      const share = Math.min(255, Math.max(0, Math.round(((values[pixel] - this.low) / top) * 255)));
      const at = 4 * (row * grid.columns + (place % grid.columns));
      bytes.set(colours.subarray(4 * share, 4 * share + 4), at);
    }
    this.lattice.getContext("2d").putImageData(picture, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.lattice, 0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.marks, 0, 0);
    this.#paintBeam();
    this.#paintCursor();
    this.frames++;
    this.canvas.dataset.frames = this.frames;
  }

  // The top of the scale: a round number above all, which goes down only after a while.
  #scale(values) {
    let most = 0;
    for (const value of values) {
      most = Math.max(most, value - this.low);
    }
    const before = this.top[this.show];
    const wanted = STEPS.find((step) => step >= most) ?? STEPS.at(-1);
    const now = performance.now();
    if (wanted >= before) {
      this.small.set(this.show, now);
    }
    if (wanted > before || now - (this.small.get(this.show) ?? now) > SHRINK_MS) {
      this.top[this.show] = wanted;
      this.rescaled();
    }
    return this.top[this.show];
  }

  #corner(pixel) {
    return [this.grid.column(pixel) * this.cell, (this.grid.rows - 1 - this.grid.row(pixel)) * this.cell];
  }

  #middle(pixel) {
    return this.#corner(pixel).map((at) => at + this.cell / 2);
  }

  #paintMask(colour) {
    const context = this.mask.getContext("2d");
    context.fillStyle = colour;
    context.fillRect(0, 0, this.mask.width, this.mask.height);
    const inset = (this.cell * GAP) / 2;
    for (let pixel = 0; pixel < this.grid.pixels; pixel++) {
      const [x, y] = this.#corner(pixel);
      context.clearRect(x + inset, y + inset, this.cell - 2 * inset, this.cell - 2 * inset);
    }
  }

  redrawMarks() {
    const context = this.marks.getContext("2d");
    context.clearRect(0, 0, this.marks.width, this.marks.height);
    context.drawImage(this.mask, 0, 0);
    context.strokeStyle = this.mark;
    const line = Math.max(2, this.cell * 0.13);
    context.lineWidth = line;
    for (let pixel = 0; pixel < this.grid.pixels; pixel++) {
      if (this.drawn[pixel] > 0) {
        const [x, y] = this.#corner(pixel);
        context.strokeRect(x + line / 2, y + line / 2, this.cell - line, this.cell - line);
      }
    }
    this.ask();
  }

  #paintBeam() {
    const { context } = this;
    if (this.beam.length < 1) {
      return;
    }
    // White on the darker part of every map, and edged for the lighter.
    context.strokeStyle = context.fillStyle = "white";
    for (let k = 1; k < this.beam.length; k++) {
      context.globalAlpha = 0.1 + (0.7 * k) / this.beam.length;
      context.lineWidth = 1 + (2 * k) / this.beam.length;
      context.beginPath();
      context.moveTo(...this.#middle(this.beam[k - 1]));
      context.lineTo(...this.#middle(this.beam[k]));
      context.stroke();
    }
    context.globalAlpha = 1;
    context.beginPath();
    context.arc(...this.#middle(this.beam.at(-1)), this.cell * 0.26, 0, 7);
    context.fill();
    context.strokeStyle = "black";
    context.stroke();
  }

  #paintCursor() {
    const [x, y] = this.#corner(this.cursor);
    const { context } = this;
    context.lineWidth = Math.max(2, this.cell * 0.1);
    context.strokeStyle = this.ink;
    context.setLineDash([this.cell * 0.25, this.cell * 0.25]);
    context.strokeRect(x + 1, y + 1, this.cell - 2, this.cell - 2);
    context.setLineDash([]);
  }

  // The pixel under a pointer, -1 where there is none.
  under(event) {
    const box = this.canvas.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) / box.width) * this.grid.columns);
    const row = this.grid.rows - 1 - Math.floor(((event.clientY - box.top) / box.height) * this.grid.rows);
    return this.grid.at(row, column);
  }
}
