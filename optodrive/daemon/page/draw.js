// Drawing on the grid by mouse, touch and keys; a picture laid over it.

const ARROWS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
const FINE = 16;
const DARK_BELOW = 0.02;

// The mean of RGBA bytes, 0 to 1; what is transparent is dark, inverted or not.
function brightness(bytes, invert) {
  let sum = 0;
  for (let at = 0; at < bytes.length; at += 4) {
    const grey = (0.299 * bytes[at] + 0.587 * bytes[at + 1] + 0.114 * bytes[at + 2]) / 255;
    sum += (invert ? 1 - grey : grey) * (bytes[at + 3] / 255);
  }
  return sum / (bytes.length / 4);
}

export class Drawing extends EventTarget {
  // heights: µm by pixel, written to; editing: whether strokes draw or only pick
  constructor(view) {
    super();
    this.view = view;
    this.heights = view.drawn;
    this.editing = true;
    this.tool = "raise";
    this.height = 100;
    this.last = -1;
    const { canvas } = view;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#stroke(event));
    canvas.addEventListener("pointerup", () => (this.last = -1));
    canvas.addEventListener("pointercancel", () => (this.last = -1));
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  get count() {
    return this.heights.reduce((sum, height) => sum + (height > 0), 0);
  }

  set(pixel, height) {
    if (this.heights[pixel] !== height) {
      this.heights[pixel] = height;
      this.#changed();
    }
  }

  clear() {
    this.heights.fill(0);
    this.#changed();
  }

  // All that is drawn gets another height, pictures keep their shades.
  rescale(height) {
    const most = this.heights.reduce((a, b) => Math.max(a, b), 0);
    if (most > 0 && height > 0) {
      this.heights.forEach((old, pixel) => (this.heights[pixel] = (old / most) * height));
      this.#changed();
    }
    this.height = height;
  }

  // A picture fitted whole into the grid, each pixel as bright as what it covers on the average.
  async lay(file, invert) {
    const { grid } = this.view;
    const image = await createImageBitmap(file);
    const canvas = new OffscreenCanvas(grid.columns * FINE, grid.rows * FINE);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.imageSmoothingQuality = "high";
    const scale = Math.min(canvas.width / image.width, canvas.height / image.height);
    const [width, height] = [image.width * scale, image.height * scale];
    context.drawImage(image, (canvas.width - width) / 2, (canvas.height - height) / 2, width, height);
    for (let pixel = 0; pixel < grid.pixels; pixel++) {
      const [x, y] = [grid.column(pixel) * FINE, (grid.rows - 1 - grid.row(pixel)) * FINE];
      const bright = brightness(context.getImageData(x, y, FINE, FINE).data, invert);
      this.heights[pixel] = bright > DARK_BELOW ? Math.round(bright * this.height * 10) / 10 : 0;
    }
    this.#changed();
  }

  pick(pixel) {
    this.view.cursor = pixel;
    this.view.ask();
    this.dispatchEvent(new CustomEvent("picked", { detail: pixel }));
  }

  #changed() {
    this.view.redrawMarks();
    this.dispatchEvent(new Event("changed"));
  }

  #apply(pixel) {
    this.pick(pixel);
    if (this.editing) {
      this.set(pixel, this.tool === "raise" ? this.height : 0);
    }
  }

  #down(event) {
    const pixel = this.view.under(event);
    if (event.button === 0 && pixel >= 0) {
      this.view.canvas.setPointerCapture(event.pointerId);
      this.last = pixel;
      this.#apply(pixel);
    }
  }

  #stroke(event) {
    if (this.last < 0) {
      return;
    }
    for (const point of event.getCoalescedEvents?.() ?? [event]) {
      const pixel = this.view.under(point);
      if (pixel >= 0 && pixel !== this.last) {
        this.last = pixel;
        this.#apply(pixel);
      }
    }
  }

  #key(event) {
    const step = ARROWS[event.key];
    if (step) {
      event.preventDefault();
      this.pick(this.view.grid.from(this.view.cursor, ...step));
    } else if (event.key === " " || event.key === "Enter") {
      event.preventDefault();
      const pixel = this.view.cursor;
      if (this.editing) {
        this.set(pixel, this.heights[pixel] > 0 ? 0 : this.height);
        this.pick(pixel);
      }
    }
  }
}
