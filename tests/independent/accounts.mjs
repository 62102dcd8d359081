// Accounts of the emitted light, written from PROTOCOL.md alone: B4 to B6 under "Guards".

const CENTRE = 32768;
const FULL = 65535n;
const MEAN_WINDOW_US = 1_000_000;
const PJ_PER_UJ = 1_000_000n;
const GRIDS = [[0, 0], [1, 0], [0, 1], [1, 1]];

const divideUp = (value, divisor) => Number((value + divisor - 1n) / divisor);

/** What the board remembers of its pulses. It persists over sessions and faults. */
export class Accounts {
  #settings;
  #grids = GRIDS.map(() => new Map());
  #window = [];

  constructor(settings) {
    this.#settings = settings;
  }

  /** Count a pulse that is to begin at a time, or return the name of the fault that it would be. */
  begin(point, at, limits) {
    const fault = this.lacksAccounts(point, at, limits) || this.exceedsOnTime(point, at, limits) ||
      this.exceedsMeanPower(point, at, limits) || this.exceedsEnergy(point, at, limits) ||
      this.lacksMemory();
    if (!fault) this.count(point, at, limits);
    return fault;
  }

  lacksAccounts(point, at, limits) {
    const keys = keysOf(point, this.#settings.cell_codes);
    return this.#grids.every((grid, k) => grid.has(keys[k]) || this.hasRoom(grid, at, limits)) ? "" : "CELLS";
  }

  exceedsOnTime(point, at, limits) {
    const most = Math.max(...this.cellsOf(point).map((cell) => this.onTime(cell, at, limits)));
    return most + point.on_us > limits.max_on_us ? "ON_TIME" : "";
  }

  /** A pulse is remembered for a second after its end; of the power, only what falls into the second counts. */
  exceedsMeanPower(point, at, limits) {
    this.#window = this.#window.filter((pulse) => pulse.end > at - MEAN_WINDOW_US);
    const since = at + point.on_us - MEAN_WINDOW_US;
    const sum = this.#window.reduce(
      (total, { end, onUs, duty }) => total + Math.max(0, Math.min(onUs, end - since)) * duty, point.on_us * point.duty,
    );
    return sum > MEAN_WINDOW_US * limits.mean_duty ? "MEAN_POWER" : "";
  }

  lacksMemory() {
    return this.#window.length >= this.#settings.window_pulses ? "PULSES" : "";
  }

  exceedsEnergy(point, at, limits) {
    const most = Math.max(...this.cellsOf(point).map((cell) => this.energyUj(cell, at, limits)));
    return most + pulseUj(point, limits) > limits.spot_uj ? "SPOT" : "";
  }

  hasRoom(grid, at, limits) {
    if (grid.size >= this.#settings.cells) {
      for (const [key, cell] of grid) if (this.isIdle(cell, at, limits)) grid.delete(key);
    }
    return grid.size < this.#settings.cells;
  }

  count(point, at, limits) {
    const end = at + point.on_us;
    this.#window.push({ end, onUs: point.on_us, duty: point.duty });
    keysOf(point, this.#settings.cell_codes).forEach((key, k) => {
      const cell = this.#grids[k].get(key);
      const onUs = this.onTime(cell, at, limits) + point.on_us;
      this.#grids[k].set(key, { onUs, end, uj: this.energyUj(cell, at, limits) + pulseUj(point, limits), since: at });
    });
  }

  cellsOf(point) {
    return keysOf(point, this.#settings.cell_codes).map((key, k) => this.#grids[k].get(key));
  }

  /** Return the gate-on time of a cell in µs; a rest clears it. */
  onTime(cell, at, limits) {
    return cell && !hasRested(cell, at, limits) ? cell.onUs : 0;
  }

  /** Return what the bucket of a cell holds in µJ. */
  energyUj(cell, at, limits) {
    if (!cell) return 0;
    const drained = (BigInt(at - cell.since) * BigInt(limits.spot_leak_uw)) / PJ_PER_UJ;
    return Math.max(0, cell.uj - Number(drained));
  }

  isIdle(cell, at, limits) {
    return hasRested(cell, at, limits) && this.energyUj(cell, at, limits) === 0;
  }
}

function keysOf(point, cellCodes) {
  const half = Math.floor(cellCodes / 2);
  const cell = (code, shift) => Math.floor((code - CENTRE + shift * half) / cellCodes);
  return GRIDS.map(([right, up]) => `${cell(point.x, right)},${cell(point.y, up)}`);
}

const hasRested = (cell, at, limits) => at - cell.end >= limits.rest_us;

const pulseUj = (point, limits) =>
  divideUp(BigInt(point.on_us) * BigInt(point.duty) * BigInt(limits.full_power_uw), FULL * PJ_PER_UJ);
