// The display: one square per pixel, the drawing, the page that stands, fingers, and the path of the beam. A picture of the grid is scaled up.

import { buildColourMap, readThemeColour } from "./colours.js";

const SIZE = 680;
const GAP = 0.12;

export class DisplayView {
  constructor(canvas, grid) {
    this.canvas = canvas;
    this.grid = grid;
    this.quantity = "height";
    this.cursor = grid.centre();
    this.drawn = new Float32Array(grid.pixels);
    this.page = new Uint16Array(grid.pixels);
    this.fingers = []; // label, and place and radius in pitches from the first column and row
    this.beamPath = [];
    this.values = { height: new Float32Array(grid.pixels), absorber: new Float32Array(grid.pixels), preview: new Float32Array(grid.pixels) };
    this.ambient = 20;
    this.maxUm = 200;
    this.maxC = 100;
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
    this.setColourMap("viridis");
    this.paintRequested = false;
  }

  setColourMap(name) {
    this.colours = buildColourMap(name);
    this.applyTheme();
  }

  // Read the colours of the theme and repaint everything that depends on them.
  applyTheme() {
    this.ink = readThemeColour("ink");
    this.mark = readThemeColour("mark");
    this.#paintMask(readThemeColour("well"));
    this.redrawMarks();
  }

  // Set heights in µm and absorber temperatures in °C.
  setValues(height, absorber) {
    this.values.height = height;
    this.values.absorber = absorber;
    this.requestPaint();
  }

  requestPaint() {
    if (!this.paintRequested) {
      this.paintRequested = true;
      requestAnimationFrame(() => this.paint());
    }
  }

  get scaleMin() {
    return this.quantity === "absorber" ? this.ambient : 0;
  }

  // The scale is fixed: a colour means the same height all the time.
  get scaleMax() {
    return this.quantity === "absorber" ? this.maxC : this.maxUm;
  }

  paint() {
    this.paintRequested = false;
    const { grid, context, picture, colours } = this;
    const values = this.values[this.quantity];
    const range = this.scaleMax - this.scaleMin;
    const bytes = picture.data;
    for (let pixel = 0; pixel < grid.pixels; pixel++) {
      const position = grid.positions[pixel];
      const row = grid.rows - 1 - Math.floor(position / grid.columns);
      const level = Math.min(255, Math.max(0, Math.round(((values[pixel] - this.scaleMin) / range) * 255)));
      const offset = 4 * (row * grid.columns + (position % grid.columns));
      bytes.set(colours.subarray(4 * level, 4 * level + 4), offset);
    }
    this.lattice.getContext("2d").putImageData(picture, 0, 0);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.lattice, 0, 0, this.canvas.width, this.canvas.height);
    context.drawImage(this.marks, 0, 0);
    this.#paintBeam();
    this.#paintFingers();
    this.#paintCursor();
    this.frames++;
    this.canvas.dataset.frames = this.frames;
  }

  #corner(pixel) {
    return [this.grid.column(pixel) * this.cell, (this.grid.rows - 1 - this.grid.row(pixel)) * this.cell];
  }

  #centre(pixel) {
    return this.#corner(pixel).map((coordinate) => coordinate + this.cell / 2);
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
      if (this.page[pixel] > 0) {
        context.beginPath();
        context.arc(...this.#centre(pixel), (this.cell - line) / 2, 0, 7);
        context.stroke();
      }
    }
    this.requestPaint();
  }

  #paintBeam() {
    const { context, beamPath } = this;
    if (beamPath.length < 1) {
      return;
    }
    // White, which contrasts with the darker part of every map, with an edge for the lighter part.
    context.strokeStyle = context.fillStyle = "white";
    for (let k = 1; k < beamPath.length; k++) {
      context.globalAlpha = 0.1 + (0.7 * k) / beamPath.length;
      context.lineWidth = 1 + (2 * k) / beamPath.length;
      context.beginPath();
      context.moveTo(...this.#centre(beamPath[k - 1]));
      context.lineTo(...this.#centre(beamPath[k]));
      context.stroke();
    }
    context.globalAlpha = 1;
    context.beginPath();
    context.arc(...this.#centre(beamPath.at(-1)), this.cell * 0.26, 0, 7);
    context.fill();
    context.strokeStyle = "black";
    context.stroke();
  }

  // White discs with a dark edge contrast with every colour of the maps; the number tells them apart.
  #paintFingers() {
    const { context, cell } = this;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.font = `700 ${Math.max(14, cell * 0.9)}px system-ui, sans-serif`;
    for (const { label, column, row, radius } of this.fingers) {
      const [x, y] = [(column + 0.5) * cell, (this.grid.rows - 0.5 - row) * cell];
      for (const [width, colour] of [[5, "black"], [2, "white"]]) {
        context.lineWidth = width;
        context.strokeStyle = colour;
        context.beginPath();
        context.arc(x, y, Math.max(radius, 0.5) * cell, 0, 7);
        context.stroke();
      }
      context.lineWidth = 4;
      context.strokeStyle = "black";
      context.strokeText(label, x, y);
      context.fillStyle = "white";
      context.fillText(label, x, y);
    }
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

  // Return the pixel under a pointer, -1 if there is none.
  pixelAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const column = Math.floor(((event.clientX - box.left) / box.width) * this.grid.columns);
    const row = this.grid.rows - 1 - Math.floor(((event.clientY - box.top) / box.height) * this.grid.rows);
    return this.grid.at(row, column);
  }
}
