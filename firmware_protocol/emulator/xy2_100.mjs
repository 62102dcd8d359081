// The PIO in the chip's time, which the emulator runs at the computer's, and what stands at its pins: a decoder of XY2-100
// that judges every frame, and a scan head that answers.

const PIN = { clock: 16, sync: 17, x: 18, y: 19, status: 21 };
const CYCLE_NANOS = 8;
const STEP_NANOS = 250; // half a bit: the DMA acts between two steps
const BIT_NANOS = 500, BIT_ERROR_NANOS = 10;
const HOLD_NANOS = 50; // of data before and after the clock falls
const FRAME_BITS = 20;
const HEAD_NANOS = 160; // from the board's clock to the status at the board's pin: 10 m of cable and the head
const LOW = 0, HIGH = 1;
export const STATUS_OK = 0b1111110111111101;

// Whether 20 bits are a frame: control bits 001, even parity.
function findError(bits) {
  if (bits >>> 17 !== 1) return "control bits";
  let ones = 0;
  for (let k = 0; k < FRAME_BITS; k++) ones += (bits >>> k) & 1;
  return ones % 2 ? "parity" : "";
}

export function encodeStatus(word) {
  const bits = (1 << 17) | ((word & 0xffff) << 1);
  return bits | (findError(bits) ? 1 : 0);
}

class Decoder {
  constructor(emit) {
    Object.assign(this, { emit, frames: 0, errors: 0, place: [], bits: 0, x: 0, y: 0, fell: -Infinity, synced: false });
    this.changed = { sync: -Infinity, x: -Infinity, y: -Infinity };
    this.level = { sync: false, x: false, y: false };
  }

  fail(at, what) {
    if (!this.synced) return;
    this.errors++;
    this.emit("frame_error", at / 1000, what);
  }

  // A line other than the clock, at a time.
  onLine(name, high, at) {
    if (this.level[name] === high) return;
    if (at - this.fell < HOLD_NANOS) this.fail(at, `${name}: hold`);
    this.level[name] = high;
    this.changed[name] = at;
  }

  onFall(at) {
    const { level, changed } = this;
    if (at - Math.max(changed.sync, changed.x, changed.y) < HOLD_NANOS) this.fail(at, "set-up");
    if (Math.abs(at - this.fell - BIT_NANOS) > BIT_ERROR_NANOS) this.fail(at, "clock");
    this.fell = at;
    this.x = (this.x << 1) | (level.x ? 1 : 0);
    this.y = (this.y << 1) | (level.y ? 1 : 0);
    this.bits++;
    if (!level.sync) this.onFrame(at);
    else if (this.bits === FRAME_BITS) this.fail(at, "no SYNC");
  }

  onFrame(at) {
    if (this.synced) {
      this.frames++;
      if (this.bits !== FRAME_BITS) this.fail(at, `${this.bits} bits`);
      for (const axis of ["x", "y"]) {
        const error = findError(this[axis] & 0xfffff);
        if (error) this.fail(at, `${axis}: ${error}`);
      }
      const x = (this.x >>> 1) & 0xffff, y = (this.y >>> 1) & 0xffff;
      if (x !== this.place[0] || y !== this.place[1]) this.emit("mirrors", at / 1000, x, y);
      this.place = [x, y];
    }
    this.synced = true;
    this.bits = this.x = this.y = 0;
  }
}

// Answers each clock that rises with a bit of its status, or lets the line idle. answer: frame (null: none), line, bad: frames
// whose parity is wrong.
class Head {
  constructor(answer, setStatus) {
    Object.assign(this, { answer, setStatus, sent: 0, next: null, at: 0 });
  }

  onRise(at, isFirst) {
    const { answer } = this;
    if (isFirst) {
      this.sent = 0;
      this.frame = answer.bad > 0 ? answer.frame ^ 1 : answer.frame;
      if (answer.bad > 0) answer.bad--;
    }
    this.next = answer.frame === null ? answer.line : ((this.frame >>> (FRAME_BITS - 1 - this.sent)) & 1) === 1;
    this.at = at + HEAD_NANOS;
    this.sent++;
  }

  advance(now) {
    if (this.next === null || now < this.at) return;
    this.level = this.next;
    this.setStatus(this.next);
    this.next = null;
  }
}

// What decides the rest of a frame from its fourth bit on, before which the machines fetch their words.
const REGISTERS = ["pc", "x", "y", "outputShiftReg", "outputShiftCount", "inputShiftReg", "inputShiftCount"];
const FETCHED_BITS = 4;

export class Xy2100 {
  // answer: of the head; setPin: of the circuit; everyFrame: whether one that is as the last one is played, too
  constructor(rp2040, clock, baseNanos, answer, everyFrame, emit, setPin) {
    Object.assign(this, { rp2040, clock, baseNanos, everyFrame, pins: 0, known: null });
    this.pio = rp2040.pio[0];
    this.decoder = new Decoder(emit);
    let level = null;
    this.head = new Head(answer, (high) => {
      if (high !== level) setPin(PIN.status, (level = high));
    });
    this.pio.run = () => this.start();
    const { gpio } = rp2040;
    for (const machine of this.pio.machines) { // as fast, for one bit
      Object.defineProperty(machine, "inPins", { get: () => (gpio[machine.inBase].inputValue ? 1 : 0) });
    }
    this.alarm = clock.createAlarm(() => this.advance());
  }

  start() {
    this.began = this.clock.nanos;
    this.running = this.pio.machines.filter((machine) => machine.enabled).map((machine) => {
      machine.cycles = 0;
      return { machine, nanos: CYCLE_NANOS * (machine.clockDivInt + machine.clockDivFrac / 256) };
    });
    this.alarm.schedule(STEP_NANOS);
  }

  // Steps the machines up to now, those of one time before the pins of that time are looked at.
  advance() {
    const now = this.clock.nanos - this.began, { running, head } = this;
    for (;;) {
      let at = Infinity;
      for (const { machine, nanos } of running) at = Math.min(at, machine.cycles * nanos);
      if (!(at <= now)) break;
      head.advance(this.began + at);
      for (const { machine, nanos } of running) {
        if (machine.cycles * nanos !== at) continue;
        machine.step();
        if (machine.waiting) machine.cycles++; // a cycle in which it waits
      }
      if (this.pio.pinValues !== this.pins) this.onPins(this.began + at);
    }
    if (this.pio.stopped) return;
    const next = running.length ? running[0].machine.cycles * running[0].nanos - now : 0;
    this.alarm.schedule(Math.max(STEP_NANOS, next));
  }

  // At the fall of a clock: remembers how a frame went on from its fourth bit, and lets an equal one go on so at once.
  repeat(at) {
    const { decoder, head, running, known } = this, { frame, bad } = head.answer;
    if (decoder.bits === FETCHED_BITS && decoder.synced && bad === 0 && frame !== null && frame === head.frame) {
      const key = [decoder.x, decoder.y, frame, ...running.flatMap(({ machine }) => REGISTERS.map((name) => machine[name]))];
      if (known?.end && known.key.join() === key.join() && known.errors === decoder.errors) this.skip(at, known.end);
      else this.known = { key, errors: decoder.errors, at };
    } else if (decoder.bits === 0 && known && !known.end && frame === head.frame && known.at + FRAME_BITS * BIT_NANOS > at) {
      const registers = running.map(({ machine }) => REGISTERS.map((name) => machine[name]));
      const cycles = Math.round((at - known.at) / running[0].nanos);
      const changed = Object.fromEntries(Object.entries(decoder.changed).map(([name, when]) => [name, when - decoder.fell]));
      known.end = { registers, cycles, pins: this.pins, changed, level: { ...decoder.level }, status: head.level, last: at };
    }
  }

  skip(at, { registers, cycles, pins, changed, level, status }) {
    const { decoder, head, running } = this;
    for (const [k, { machine }] of running.entries()) {
      REGISTERS.forEach((name, n) => (machine[name] = registers[k][n]));
      machine.cycles += cycles;
    }
    this.pio.pinValues = this.pins = pins;
    head.sent = FRAME_BITS;
    head.next = null;
    head.setStatus(status);
    decoder.fell = this.baseNanos + at + cycles * running[0].nanos;
    for (const name in changed) decoder.changed[name] = decoder.fell + changed[name];
    Object.assign(decoder.level, level);
    decoder.bits = decoder.x = decoder.y = 0;
    decoder.frames++;
  }

  onPins(at) {
    const { decoder, head } = this, { gpio } = this.rp2040, time = this.baseNanos + at;
    const changed = this.pins ^ this.pio.pinValues, clock = gpio[PIN.clock].value;
    this.pins = this.pio.pinValues;
    if (clock !== LOW && clock !== HIGH) return; // not connected yet
    for (const name of ["sync", "x", "y"]) {
      if (changed & (1 << PIN[name])) decoder.onLine(name, gpio[PIN[name]].value === HIGH, time);
    }
    if (!(changed & (1 << PIN.clock))) return;
    if (clock === HIGH) head.onRise(at, decoder.bits === 0);
    else {
      decoder.onFall(time);
      if (!this.everyFrame) this.repeat(at);
    }
  }
}
