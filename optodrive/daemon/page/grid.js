// Where pixels lie: rows from the bottom, as the daemon counts them.

export class Grid {
  constructor(config) {
    const display = config.display;
    this.rows = display.rows;
    this.columns = display.columns;
    const missing = new Set(display.missing.map(([row, column]) => row * this.columns + column));
    this.place = [];
    this.index = new Int32Array(this.rows * this.columns).fill(-1);
    for (let place = 0; place < this.rows * this.columns; place++) {
      if (!missing.has(place)) {
        this.index[place] = this.place.length;
        this.place.push(place);
      }
    }
    this.pixels = this.place.length;
  }

  row(pixel) {
    return Math.floor(this.place[pixel] / this.columns);
  }

  column(pixel) {
    return this.place[pixel] % this.columns;
  }

  // The pixel at a place, -1 where there is none.
  at(row, column) {
    const inside = row >= 0 && row < this.rows && column >= 0 && column < this.columns;
    return inside ? this.index[row * this.columns + column] : -1;
  }

  // From a pixel so many steps on, over places that are missing; the pixel itself at the border.
  from(pixel, up, right) {
    for (let step = 1; step <= Math.max(this.rows, this.columns); step++) {
      const other = this.at(this.row(pixel) + up * step, this.column(pixel) + right * step);
      if (other >= 0) {
        return other;
      }
    }
    return pixel;
  }

  middle() {
    return this.at(Math.floor(this.rows / 2), Math.floor(this.columns / 2));
  }
}

// Little-endian 16-bit numbers from base64, whatever the machine's own order.
export function numbers(base64) {
  const text = atob(base64);
  const values = new Uint16Array(text.length / 2);
  for (let k = 0; k < values.length; k++) {
    values[k] = text.charCodeAt(2 * k) | (text.charCodeAt(2 * k + 1) << 8);
  }
  return values;
}
