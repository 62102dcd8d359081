// The emulator's process: node bench.mjs SETUP.json; commands as JSON lines in, records and then "done" as JSON lines out.

import { readFileSync, writeSync } from "node:fs";
import { createInterface } from "node:readline";

import { Chip } from "./chip.mjs";
import { encodeStatus, STATUS_OK } from "./xy2_100.mjs";

const setup = JSON.parse(readFileSync(process.argv[2], "utf8"));
const emulator = await import(setup.emulator);
setup.mirrorFault = { name: "", stuck: 0 };
setup.flash = Uint8Array.from(Buffer.from(setup.image, "hex"));

let seed = setup.seed || 1;
const random = () => {
  seed ^= seed << 13;
  seed ^= seed >>> 17;
  seed ^= seed << 5;
  return seed >>> 0;
};

const computer = { connected: false, awake: true, open: false, reads: true }; // at the USB port
const head = { frame: encodeStatus(STATUS_OK), line: false, bad: 0 };
let records = [], pins = new Map(), chip;
const emit = (...record) => records.push(record);
const flush = (record) => {
  writeSync(1, JSON.stringify([...records, record]) + "\n");
  records = [];
};

// A reset lets all pins float, so the pull-downs of the circuit hold the gate off.
function start(cause) {
  const base = chip ? chip.base + chip.clock.nanos : 0, memory = chip?.rp2040.sram;
  if (chip) {
    chip.ended = true;
    if (chip.gateOpen) emit("pin", base / 1000, false, 0);
    if (chip.logged) emit("gate", base / 1000, false, 0, -2, 0, 0, 0);
    emit("reset", base / 1000, cause);
  }
  chip = new Chip(emulator, setup, base, cause, memory, computer, head, random, emit, () => start("watchdog"));
  for (const [pin, high] of pins) chip.setPin(pin, high);
}

const commands = {
  run(us) {
    while (chip.micros < us) chip.run(us * 1000 - chip.base); // again after a reset
    chip.countBadFrames();
  },
  bytes(hex) { chip.uart.feed(Buffer.from(hex, "hex")); },
  pin(number, high) {
    pins.set(number, high);
    chip.setPin(number, high);
  },
  usb(action, ...values) { chip.usb[action](...values); },
  reset() { start("run"); },
  ticks() {
    emit("ticks", chip.tickMax, chip.gapMax);
    chip.tickMax = chip.gapMax = 0;
  },
  head(answer) { Object.assign(head, answer); },
  everyFrame() { setup.everyFrame = chip.xy2.everyFrame = true; },
  frames() { emit("frames", chip.xy2.decoder.frames, chip.xy2.decoder.errors); },
  stack() { emit("stack", ...chip.measureStack()); },
  trace(on) {
    setup.tracing = on;
    if (on) chip.traceLevels(-1);
  },
  inject(name) { chip.inject(name); },
  mirror(fault) { chip.mirrors.inject(fault); },
  break() { chip.uart.feed([1 << 10]); },
};

start("power");
for await (const line of createInterface({ input: process.stdin })) {
  const [name, ...values] = JSON.parse(line);
  commands[name](...values);
  flush(["done", chip.micros]);
}
