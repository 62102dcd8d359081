// Drawing on the grid by mouse, touch and keys, or from a picture.

const ARROWS = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
const SAMPLES = 16;
const BRIGHTNESS_MIN = 0.02;

// Return the mean brightness of RGBA bytes, 0 to 1; transparent samples are dark, inverted or not.
function brightness(bytes, invert) {
  let sum = 0;
  for (let at = 0; at < bytes.length; at += 4) {
    const grey = (0.299 * bytes[at] + 0.587 * bytes[at + 1] + 0.114 * bytes[at + 2]) / 255;
    sum += (invert ? 1 - grey : grey) * (bytes[at + 3] / 255);
  }
  return sum / (bytes.length / 4);
}

export class Drawing extends EventTarget {
  // heights: target per pixel, a height in µm or an intensity; editing: whether strokes draw or only select
  constructor(view) {
    super();
    this.view = view;
    this.heights = view.drawn;
    this.editing = true;
    this.tool = "raise";
    this.height = 100;
    this.lastPixel = -1;
    const { canvas } = view;
    canvas.addEventListener("pointerdown", (event) => this.#onPointerDown(event));
    canvas.addEventListener("pointermove", (event) => this.#onPointerMove(event));
    canvas.addEventListener("pointerup", () => (this.lastPixel = -1));
    canvas.addEventListener("pointercancel", () => (this.lastPixel = -1));
    canvas.addEventListener("keydown", (event) => this.#onKeyDown(event));
  }

  get count() {
    return this.heights.reduce((sum, height) => sum + (height > 0), 0);
  }

  set(pixel, height) {
    if (this.heights[pixel] !== height) {
      this.heights[pixel] = height;
      this.#notifyChange();
    }
  }

  clear() {
    this.heights.fill(0);
    this.#notifyChange();
  }

  // Scale the drawing so that its largest height is the given one; a picture keeps its shades.
  rescale(height) {
    const max = this.heights.reduce((a, b) => Math.max(a, b), 0);
    if (max > 0 && height > 0) {
      this.heights.forEach((old, pixel) => (this.heights[pixel] = (old / max) * height));
      this.#notifyChange();
    }
    this.height = height;
  }

  // Fit a picture into the grid; each pixel gets the mean brightness of the area that it covers.
  async placePicture(file, invert) {
    const { grid } = this.view;
    const image = await createImageBitmap(file);
    const canvas = new OffscreenCanvas(grid.columns * SAMPLES, grid.rows * SAMPLES);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.imageSmoothingQuality = "high";
    const scale = Math.min(canvas.width / image.width, canvas.height / image.height);
    const [width, height] = [image.width * scale, image.height * scale];
    context.drawImage(image, (canvas.width - width) / 2, (canvas.height - height) / 2, width, height);
    for (let pixel = 0; pixel < grid.pixels; pixel++) {
      const [x, y] = [grid.column(pixel) * SAMPLES, (grid.rows - 1 - grid.row(pixel)) * SAMPLES];
      const mean = brightness(context.getImageData(x, y, SAMPLES, SAMPLES).data, invert);
      this.heights[pixel] = mean > BRIGHTNESS_MIN ? Math.round(mean * this.height * 100) / 100 : 0;
    }
    this.#notifyChange();
  }

  select(pixel) {
    this.view.cursor = pixel;
    this.view.requestPaint();
    this.dispatchEvent(new CustomEvent("selected", { detail: pixel }));
  }

  #notifyChange() {
    this.view.redrawMarks();
    this.dispatchEvent(new Event("changed"));
  }

  #apply(pixel) {
    this.select(pixel);
    if (this.editing) {
      this.set(pixel, this.tool === "raise" ? this.height : 0);
    }
  }

  #onPointerDown(event) {
    const pixel = this.view.pixelAt(event);
    if (event.button === 0 && pixel >= 0) {
      this.view.canvas.setPointerCapture(event.pointerId);
      this.lastPixel = pixel;
      this.#apply(pixel);
    }
  }

  #onPointerMove(event) {
    if (this.lastPixel < 0) {
      return;
    }
    for (const point of event.getCoalescedEvents?.() ?? [event]) {
      const pixel = this.view.pixelAt(point);
      if (pixel >= 0 && pixel !== this.lastPixel) {
        this.lastPixel = pixel;
        this.#apply(pixel);
      }
    }
  }

  #onKeyDown(event) {
    const step = ARROWS[event.key];
    if (step) {
      event.preventDefault();
      this.select(this.view.grid.findNeighbour(this.view.cursor, ...step));
    } else if (event.key === " " || event.key === "Enter") {
      event.preventDefault();
      const pixel = this.view.cursor;
      if (this.editing) {
        this.set(pixel, this.heights[pixel] > 0 ? 0 : this.height);
        this.select(pixel);
      }
    }
  }
}
