// One power cycle of an RP2040 with the firmware's image, its circuit and a witness of its pins; with the image's symbols, of
// what its core does, too.

import { Mirrors } from "./mirrors.mjs";
import { Uart } from "./uart.mjs";
import { UsbHost } from "./usb.mjs";
import { Xy2100 } from "./xy2_100.mjs";

const RAM = 0x20000000, RAM_BYTES = 264 * 1024, FLASH = 0x10000000;
const PIN = { hostClosed: 2, estop: 8, key: 9, interlock: 10, indicator: 11, relay: 12, readback: 13, gate: 14, sync: 17, tick: 22 };
const TRACED = [PIN.indicator, PIN.relay, PIN.sync, PIN.tick];
const CYCLE_NANOS = 8; // 125 MHz
const SPI_BYTE_NANOS = 384; // 8 bits at 20.8 MHz
const OUT_SET = 0x14, OUT_CLEAR = 0x18;
const GATE_CTRL = 8 * PIN.gate + 4, PWM_CSR = 0x14 * 7, PWM_CC = PWM_CSR + 0x0c;
const FUNCTION_PWM = 4;
const TIMER_IRQ = 0, UART_IRQ = 20;
const HAD_POR = 1 << 8, HAD_RUN = 1 << 16;
const FAULT_REASON = 14;
const PAINT = 0xa5a5a5a5; // of the stack that was never used

// Registers that the emulator leaves out: one value each, or a function of the offset.
const stub = (read) => ({ readUint32: read, writeUint32() {}, writeUint32Atomic() {} });

export class Chip {
  // cause: "power", "run" (the pin RUN) or "watchdog"; base: nanoseconds since the first power-up; emit: takes records
  // computer: at the USB port; head: what the scan head answers
  constructor({ RP2040, USBCDC }, setup, base, cause, memory, computer, head, random, emit, onWatchdog) {
    Object.assign(this, { setup, base, emit, sram: null });
    const rp2040 = (this.rp2040 = new RP2040());
    rp2040.logger = { debug() {}, info() {}, warn() {}, error: (name, text) => { throw new Error(`${name}: ${text}`); } };
    if (memory) rp2040.sram.set(memory);
    rp2040.flash.set(setup.flash);
    this.ram = rp2040.sramView;
    this.at = setup.symbols ?? {};
    for (let at = this.at.bss_end; at < RAM + RAM_BYTES; at += 4) this.ram.setUint32(at - RAM, PAINT, true);
    this.core = rp2040.core;
    this.clock = rp2040.clock;
    this.uart = new Uart(rp2040, UART_IRQ, (byte) => emit("byte", this.micros, byte));
    rp2040.peripherals[0x40034] = this.uart;
    this.usb = new UsbHost(rp2040, USBCDC, computer, (name, ...record) => emit(name, this.micros, ...record));
    rp2040.peripherals[0x40060] = stub((offset) => (offset === 0x1c ? random() : 0));
    rp2040.peripherals[0x40064] = stub(() => (cause === "run" ? HAD_RUN : HAD_POR));
    const watchdog = rp2040.peripherals[0x40058];
    watchdog.reason = cause === "watchdog" ? 1 : 0;
    watchdog.onWatchdogTrigger = () => {
      watchdog.timer.enable = false; // its alarm would fire again in the same instant
      onWatchdog();
    };
    this.xy2 = new Xy2100(rp2040, this.clock, base, head, setup.everyFrame, (name, ...record) => this.onFrame(emit, name, record), (pin, high) => this.setPin(pin, high));
    this.mirrors = new Mirrors(rp2040, setup.mirrorFault, random);
    this.bend(rp2040);
    this.gateOpen = this.logged = this.stuck = this.loopStopped = this.tickStopped = false;
    this.level = {};
    this.outputs = 0;
    this.pending = null; // change of state under way
    this.badFrames = this.tickMax = this.gapMax = 0;
    this.word = null; // bytes since SYNC fell
    this.x = 32768;
    this.core.PC = FLASH; // the ROM runs the second stage, here in place
    this.core.SP = RAM + RAM_BYTES;
    this.hooks = new Uint8Array(RAM_BYTES / 2);
    for (const name of setup.symbols ? ["change_state", "outputs_set_gate", "xy2_100_move"] : []) this.hooks[(this.at[name] - RAM) >> 1] = 1;
  }

  // Adds to the emulator what the witness sees, and the time of an SPI byte.
  bend(rp2040) {
    const { sio, peripherals, spi } = rp2040;
    const [writeSio, io, pwm] = [sio.writeUint32.bind(sio), peripherals[0x40014], peripherals[0x40050]];
    sio.writeUint32 = (offset, value) => {
      writeSio(offset, value);
      if (offset === OUT_SET || offset === OUT_CLEAR) this.onPins(value, offset === OUT_SET);
    };
    for (const [peripheral, watched] of [[io, [GATE_CTRL]], [pwm, [PWM_CSR]]]) {
      const write = peripheral.writeUint32.bind(peripheral);
      peripheral.writeUint32 = (offset, value) => {
        write(offset, value);
        if (watched.includes(offset)) this.onGate();
      };
    }
    const done = this.clock.createAlarm(() => spi[0].completeTransmit(0));
    spi[0].onTransmit = (byte) => {
      this.word.push(byte);
      done.schedule(SPI_BYTE_NANOS);
    };
    const setInterrupt = rp2040.setInterrupt.bind(rp2040);
    rp2040.setInterrupt = (irq, value) => setInterrupt(irq, value && !(irq === TIMER_IRQ && this.tickStopped));
  }

  get micros() { return (this.base + this.clock.nanos) / 1000; }

  // --- the circuit ---

  setPin(pin, high) {
    this.level[pin] = high;
    this.rp2040.gpio[pin].setInputValue(high);
  }

  setReadback() {
    if (!this.stuck) this.setPin(PIN.readback, this.gateOpen);
  }

  // The level of the gate behind the PWM: off while its override forces it low.
  onGate() {
    const { gpio, pwm } = this.rp2040;
    const ctrl = gpio[PIN.gate].ctrl, compare = pwm.readUint32(PWM_CC) & 0xffff;
    const open = (ctrl & 0x31f) === FUNCTION_PWM && (pwm.readUint32(PWM_CSR) & 1) === 1 && compare > 0;
    if (open === this.gateOpen) return;
    this.gateOpen = open;
    this.emit("pin", this.micros, open, compare);
    this.setReadback();
  }

  onPins(bits, high) {
    const before = this.outputs;
    this.outputs = high ? before | bits : before & ~bits;
    if (this.setup.tracing) this.traceLevels(before ^ this.outputs);
    if (bits & (1 << PIN.sync)) {
      if (high && this.word) this.onDacWord();
      this.word = high ? null : [];
    }
    if (bits & (1 << PIN.tick)) this.onTick(high);
    if (bits & (1 << PIN.relay) && this.pending) this.onStateChanged();
  }

  traceLevels(changed) {
    for (const pin of TRACED) {
      if (changed & (1 << pin)) this.emit("level", this.micros, pin, (this.outputs & (1 << pin)) !== 0);
    }
  }

  // Longest tick, and longest time from one tick's begin to the next one's.
  onTick(begins) {
    const now = this.micros;
    if (begins) {
      this.gapMax = Math.max(this.gapMax, now - (this.began ?? now));
      this.began = now;
    } else this.tickMax = Math.max(this.tickMax, now - (this.began ?? now));
  }

  // Command, high byte, low byte: 0x00 loads output A, 0x11 loads B and updates both.
  onDacWord() {
    const [command, high, low] = this.word, value = (high << 8) | low;
    if (this.word.length !== 3) throw new Error(`DAC: ${this.word.length} bytes`);
    if (command === 0x00) this.x = value;
    else if (command === 0x11) {
      this.mirrors.moveTo(this.x, value);
      this.emit("mirrors", this.micros, this.x, value);
    }
    else this.emit("dac", this.micros, command, value);
  }

  onFrame(emit, name, record) {
    if (name === "mirrors") this.mirrors.moveTo(record[1], record[2]);
    emit(name, ...record);
  }

  // --- the log that the image itself does not write: what the core was told and what its memory says ---

  read8(name) { return this.ram.getUint8(this.at.board + this.setup.offsets[name] - RAM); }
  read16(name) { return this.ram.getUint16(this.at.board + this.setup.offsets[name] - RAM, true); }
  read32(name) { return this.ram.getUint32(this.at.board + this.setup.offsets[name] - RAM, true); }
  readTime() { return Number(this.ram.getBigUint64(this.at.board + this.setup.offsets.now_us - RAM, true)) + this.base / 1000; }

  onHook(pc) {
    const { registers } = this.core;
    if (pc === this.at.change_state) {
      this.pending = { before: this.read8("state"), reason: registers[1] };
      if (registers[1] === FAULT_REASON) this.emit("fault", this.readTime(), this.read8("fault"));
      return;
    }
    if (pc === this.at.xy2_100_move) {
      this.emit("move", this.micros);
      return;
    }
    const on = (registers[0] & 0xff) !== 0;
    if (on === this.logged) return;
    this.logged = on;
    const point = ["x", "y", "duty"].map((name) => this.read16(name));
    this.emit("gate", this.readTime(), on, this.read32("index"), this.pending ? this.pending.reason : -1, ...point);
  }

  onStateChanged() {
    this.emit("state", this.readTime(), this.read8("state"), this.pending.before, this.pending.reason);
    this.pending = null;
  }

  // Bytes of the stack that were used since power-up, and those that there are.
  measureStack() {
    const begin = this.at.bss_end, end = RAM + RAM_BYTES;
    let at = begin;
    while (at < end && this.ram.getUint32(at - RAM, true) === PAINT) at += 4;
    return [end - at, end - begin];
  }

  countBadFrames() {
    if (!this.setup.symbols) return;
    const count = this.read32("crc_errors") + this.read32("format_errors");
    if (count !== this.badFrames) this.emit("rx_error", this.micros, count);
    this.badFrames = count;
  }

  // --- time ---

  run(untilNanos) {
    const { core, clock } = this, idle = this.at.host_serve;
    this.ended = false;
    while (clock.nanos < untilNanos && !this.ended) {
      const pc = core.PC;
      if (core.waiting || (this.loopStopped && pc === idle && core.IPSR === 0)) {
        if (core.interruptsUpdated && core.checkForInterrupts()) {
          core.waiting = false;
          continue;
        }
        clock.tick(Math.max(1, Math.min(clock.nanosToNextAlarm || Infinity, untilNanos - clock.nanos)));
        continue;
      }
      if (pc >= RAM && this.hooks[(pc - RAM) >> 1]) this.onHook(pc);
      clock.tick(core.executeInstruction() * CYCLE_NANOS);
    }
  }

  // Breaks a part of the board.
  inject(name) {
    if (name === "stop_loop") this.loopStopped = true;
    else if (name === "stop_tick") this.holdTick();
    else if (name === "stick_gate") this.stuck = true;
    else {
      this.holdTick();
      this.clock.createAlarm(() => this.releaseTick()).schedule(this.setup.lateNanos);
    }
  }

  holdTick() {
    this.tickStopped = true;
    this.rp2040.setInterrupt(TIMER_IRQ, false);
  }

  releaseTick() {
    this.tickStopped = false;
    this.rp2040.peripherals[0x40054].checkInterrupts();
  }
}
