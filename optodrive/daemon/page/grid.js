// Positions of the pixels; rows count from the bottom.

export class Grid {
  constructor(config) {
    const display = config.display;
    this.rows = display.rows;
    this.columns = display.columns;
    const missing = new Set(display.missing.map(([row, column]) => row * this.columns + column));
    this.positions = [];
    this.pixelByPosition = new Int32Array(this.rows * this.columns).fill(-1);
    for (let position = 0; position < this.rows * this.columns; position++) {
      if (!missing.has(position)) {
        this.pixelByPosition[position] = this.positions.length;
        this.positions.push(position);
      }
    }
    this.pixels = this.positions.length;
  }

  row(pixel) {
    return Math.floor(this.positions[pixel] / this.columns);
  }

  column(pixel) {
    return this.positions[pixel] % this.columns;
  }

  // Return the pixel at a position, -1 if there is none.
  at(row, column) {
    const inside = row >= 0 && row < this.rows && column >= 0 && column < this.columns;
    return inside ? this.pixelByPosition[row * this.columns + column] : -1;
  }

  // Return the next pixel in a direction, across missing positions; the pixel itself at the border.
  findNeighbour(pixel, up, right) {
    for (let step = 1; step <= Math.max(this.rows, this.columns); step++) {
      const other = this.at(this.row(pixel) + up * step, this.column(pixel) + right * step);
      if (other >= 0) {
        return other;
      }
    }
    return pixel;
  }

  // Return the place of a pixel in words, counted from the top left as text is read.
  describePlace(pixel) {
    return `row ${this.rows - this.row(pixel)} of ${this.rows}, column ${this.column(pixel) + 1} of ${this.columns}`;
  }

  centre() {
    return this.at(Math.floor(this.rows / 2), Math.floor(this.columns / 2));
  }
}

// Decode little-endian 16-bit integers from base64, independent of the machine's byte order.
export function decodeUint16(base64) {
  const text = atob(base64);
  const values = new Uint16Array(text.length / 2);
  for (let k = 0; k < values.length; k++) {
    values[k] = text.charCodeAt(2 * k) | (text.charCodeAt(2 * k + 1) << 8);
  }
  return values;
}
