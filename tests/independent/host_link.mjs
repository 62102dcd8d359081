// A host's end of the link, written from PROTOCOL.md alone: "Framing", "Link", "Arming", "Duties of the host".
//
// It knows no port and no clock: poll(now) returns the bytes to send, receive(data, now) takes those that came.

import { randomBytes } from "node:crypto";

import { FRAME_MAX, Splitter, encode, isSequenced } from "./wire.mjs";

const MAJOR = 1;
const WINDOW = 8;
const PATIENCE_US = 25_000;
const BAUD = 1_000_000;
const US_PER_BYTE = 10_000_000 / BAUD;
const IN_FLIGHT_MAX = Math.max(2 * FRAME_MAX, 20_000 / US_PER_BYTE);
const HELLO_EVERY_US = 500_000;
const STATUS_EVERY_US = 20_000;
const LEASED = ["ARMING", "ARMED", "RUNNING", "HOLD"];
const OLD_TICK_EVENTS = ["EVENT", "STATUS"];
const NOT_CONSUMED = ["SEQUENCE", "NO_ROOM"];

export const newNonce = () => randomBytes(4).readUInt32LE();

export class HostLink {
  constructor() {
    this.splitter = new Splitter();
    this.hello = null;
    this.helloNonce = null;
    this.now = 0;
    this.state = this.fault = "";
    this.lastTick = 0;
    this.doneIndex = 0;
    this.statuses = 0;
    this.challenge = null;
    this.records = new Map();
    this.refusals = [];
    this.events = [];
    this.clock = null;
    this.wantsLease = false;
    this.nextHello = this.nextStatus = this.nextLease = 0;
    this.urgent = [];
    this.forgetFrames();
  }

  forgetFrames() {
    this.frames = []; // unacknowledged and waiting ones, oldest first
    this.baseSeq = 0;
    this.inFlight = 0;
    this.progressAt = 0;
    this.ignoresGaps = false;
  }

  // --- to the board ---------------------------------------------------------------------------------------------------

  /** Queue a message. A sequenced one is sent until it is consumed. */
  send(name, values = {}) {
    if (isSequenced(name)) this.frames.push({ name, values });
    else this.urgent.push(encode(name, values, { session: this.hello?.session ?? 0 }));
  }

  abort() {
    return Buffer.concat([Buffer.of(0), encode("ABORT", {}, { session: this.hello?.session ?? 0 })]);
  }

  poll(now) {
    this.now = now;
    if (!this.hello) this.greet();
    else this.keepUp();
    const out = this.urgent.concat(this.framesToSend());
    this.urgent = [];
    return out.length ? Buffer.concat([Buffer.of(0), ...out]) : Buffer.alloc(0);
  }

  greet() {
    if (this.now < this.nextHello) return;
    this.helloNonce = newNonce();
    this.nextHello = this.now + HELLO_EVERY_US;
    this.send("HELLO", { major: MAJOR, minor: 0, host_nonce: this.helloNonce });
  }

  keepUp() {
    if (this.wantsLease && this.now >= this.nextLease) {
      this.nextLease = this.now + (1000 * this.hello.lease_ms) / 5;
      this.send("LEASE", { ms: this.hello.lease_ms });
    }
    if (this.now >= this.nextStatus) {
      this.nextStatus = this.now + STATUS_EVERY_US;
      this.send("CLOCK", { host_t: this.now % 2 ** 32 });
      this.send("GET");
    }
  }

  framesToSend() {
    if (!this.hello) return [];
    let bytes = this.frames.slice(0, this.inFlight).reduce((sum, frame) => sum + frame.bytes.length, 0);
    const patience = PATIENCE_US + 2 * bytes * US_PER_BYTE;
    if (this.inFlight && this.now - this.progressAt > patience) {
      this.goBack();
      bytes = 0;
    }
    const out = [];
    while (this.inFlight < Math.min(WINDOW, this.frames.length)) {
      const frame = this.frames[this.inFlight];
      const seq = (this.baseSeq + this.inFlight) & 0xff;
      frame.bytes ??= encode(frame.name, frame.values, { seq, session: this.hello.session });
      if (bytes && bytes + frame.bytes.length > IN_FLIGHT_MAX) break;
      if (!this.inFlight) this.progressAt = this.now;
      bytes += frame.bytes.length;
      this.inFlight += 1;
      out.push(frame.bytes);
    }
    return out;
  }

  goBack() {
    this.inFlight = 0;
    this.progressAt = this.now;
  }

  /** Return whether all sequenced messages so far were consumed. */
  isIdle() {
    return !this.frames.length;
  }

  // --- from the board -------------------------------------------------------------------------------------------------

  receive(data, now) {
    this.now = now;
    for (const message of this.splitter.feed(data)) {
      if (message.error || !message.fromBoard) continue;
      if (message.name === "HELLO_REPLY") this.begin(message);
      else if (this.hello && message.frameSession === this.hello.session) this.take(message);
    }
  }

  begin(message) {
    if (this.hello || message.host_nonce !== this.helloNonce) return;
    if (message.major !== MAJOR) throw new Error(`the board speaks version ${message.major}, this host ${MAJOR}`);
    this.hello = message;
    this.forgetFrames();
  }

  take(message) {
    if (OLD_TICK_EVENTS.includes(message.name)) {
      if (message.tick < this.lastTick) return;
      this.lastTick = message.tick;
      this.takeState(message);
    }
    if (message.name === "EVENT") this.events.push(message.reason);
    if (message.name === "STATUS") {
      this.doneIndex = message.done_index;
      this.statuses += 1;
      this.status = message;
    }
    if (message.name === "ACK") this.advance(message.next_seq);
    if (message.name === "NAK") this.takeNak(message);
    if (message.name === "ARM_CHALLENGE") this.challenge = message;
    if (message.name === "CLOCK_REPLY") this.takeClock(message);
    if (message.name === "EXECUTED") {
      message.records.forEach(({ offset, on_ticks, duty }, k) =>
        this.records.set(message.first_index + k, { tick: message.base_tick + offset, on_ticks, duty }),
      );
    }
  }

  takeState({ state, fault }) {
    if (LEASED.includes(this.state) && !LEASED.includes(state)) this.wantsLease = false;
    this.state = state;
    this.fault = fault;
  }

  /** Keep the narrowest bracket of a tick between the host's times of sending and receiving. */
  takeClock({ host_t, tick }) {
    const width = (this.now - host_t) % 2 ** 32;
    if (!this.clock || width < this.clock.width) this.clock = { width, tick, at: this.now - width / 2 };
  }

  boardTick() {
    return Math.round(this.clock.tick + this.now - this.clock.at);
  }

  /** Forget the frames before a number. Return the last of them, null if none was in flight. */
  advance(nextSeq) {
    const count = (nextSeq - this.baseSeq) & 0xff;
    if (!count || count > this.inFlight) return null;
    const last = this.frames[count - 1];
    this.frames.splice(0, count);
    this.baseSeq = nextSeq;
    this.inFlight -= count;
    this.progressAt = this.now;
    this.ignoresGaps = false;
    return last;
  }

  takeNak({ next_seq, reason }) {
    const last = this.advance(next_seq);
    if (!NOT_CONSUMED.includes(reason)) {
      if (last) this.refusals.push({ name: last.name, reason });
    } else if (reason === "SEQUENCE" && !this.ignoresGaps && this.inFlight) {
      this.goBack();
      this.ignoresGaps = true;
    }
  }
}
