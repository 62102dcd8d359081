// UART 0 of the RP2040 (Arm PL011) beside the emulator, whose own one has no FIFO for sending, no time of a byte, no receive
// time-out and no break. What the port uses is here: data, flags, divisors, FIFO levels at a quarter, interrupts.

const DR = 0x00, FR = 0x18, IBRD = 0x24, FBRD = 0x28, LCR_H = 0x2c, CR = 0x30, IFLS = 0x34, IMSC = 0x38, MIS = 0x40, ICR = 0x44;
const RX = 1 << 4, TX = 1 << 5, RX_TIMEOUT = 1 << 6, BREAK_ERROR = 1 << 9, OVERRUN = 1 << 10;
const FIFO_SIZE = 32, QUARTER = 8, TIMEOUT_BITS = 32, BITS_PER_BYTE = 10;
const BREAK = 1 << 10; // in the data register

export class Uart {
  constructor(rp2040, irq, onByte) {
    Object.assign(this, { rp2040, irq, onByte });
    this.registers = new Map([[IBRD, 0], [FBRD, 0], [LCR_H, 0], [CR, 0x300], [IFLS, 0x12]]);
    this.raw = this.mask = 0;
    this.received = [];
    this.toSend = [];
    this.line = []; // bytes of the host that are on their way
    this.sending = false;
    this.sendAlarm = rp2040.clock.createAlarm(() => this.finishByte());
    this.lineAlarm = rp2040.clock.createAlarm(() => this.receiveByte());
    this.timeoutAlarm = rp2040.clock.createAlarm(() => this.raise(RX_TIMEOUT));
    this.arriving = false;
  }

  get bitNanos() {
    return (1e9 * (this.registers.get(IBRD) * 64 + this.registers.get(FBRD)) * 16) / 64 / this.rp2040.clkPeri;
  }

  // --- the host's side ---

  feed(bytes) {
    this.line.push(...bytes);
    if (!this.arriving && this.line.length) {
      this.arriving = true;
      this.lineAlarm.schedule(BITS_PER_BYTE * (this.bitNanos || 1000));
    }
  }

  receiveByte() {
    const byte = this.line.shift();
    this.arriving = false;
    if (this.received.length < FIFO_SIZE) this.received.push(byte);
    else this.raise(OVERRUN);
    if (byte & BREAK) this.raise(BREAK_ERROR);
    if (this.received.length >= QUARTER) this.raise(RX);
    this.timeoutAlarm.schedule(TIMEOUT_BITS * (this.bitNanos || 1000));
    this.feed([]);
  }

  // --- the line to the host ---

  startByte() {
    if (this.sending || !this.toSend.length) return;
    this.sending = true;
    this.shifted = this.toSend.shift();
    if (this.toSend.length === QUARTER) this.raise(TX);
    this.sendAlarm.schedule(BITS_PER_BYTE * this.bitNanos);
  }

  finishByte() {
    this.sending = false;
    this.onByte(this.shifted);
    this.startByte();
  }

  // --- interrupts ---

  raise(bits) {
    this.raw |= bits;
    this.update();
  }

  update() {
    this.rp2040.setInterrupt(this.irq, (this.raw & this.mask) !== 0);
  }

  // --- registers ---

  readUint32(offset) {
    if (offset === DR) {
      const byte = this.received.shift() ?? 0;
      if (this.received.length < QUARTER) this.raw &= ~RX;
      if (!this.received.length) {
        this.raw &= ~RX_TIMEOUT;
        this.timeoutAlarm.cancel();
      }
      this.update();
      return byte;
    }
    if (offset === FR) {
      return (this.received.length ? 0 : 1 << 4) | (this.toSend.length >= FIFO_SIZE ? 1 << 5 : 0) |
        (this.received.length >= FIFO_SIZE ? 1 << 6 : 0) | (this.toSend.length ? 0 : 1 << 7) | (this.sending ? 1 << 3 : 0);
    }
    if (offset === IMSC) return this.mask;
    if (offset === MIS) return this.raw & this.mask;
    if (!this.registers.has(offset)) throw new Error(`UART: read of register ${offset}`);
    return this.registers.get(offset);
  }

  writeUint32(offset, value) {
    if (offset === DR) {
      if (this.toSend.length < FIFO_SIZE) this.toSend.push(value & 0xff);
      if (this.toSend.length > QUARTER) this.raw &= ~TX;
      this.update();
      this.startByte();
    } else if (offset === IMSC || offset === ICR) {
      if (offset === IMSC) this.mask = value;
      else this.raw &= ~value;
      this.update();
    } else if (this.registers.has(offset)) this.registers.set(offset, value);
    else throw new Error(`UART: write of register ${offset}`);
  }

  writeUint32Atomic(offset, value, kind) {
    if (kind) throw new Error("UART: no atomic alias is in use");
    this.writeUint32(offset, value);
  }
}
