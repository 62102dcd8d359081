// A board's end of the link, written from PROTOCOL.md alone: "Framing", "Link", "Messages", "Reports".

import { randomInt } from "node:crypto";

import { Machine } from "./machine.mjs";
import { Splitter, encode, isSequenced } from "./wire.mjs";

const MAJOR = 1;
const MINOR = 1;
const TICK_HZ = 1_000_000;
const RX_WINDOW = 8;
const BEHIND_FROM = 128;
const RECORDS_KEPT = 4096;
const RECORDS_PER_REPORT = 28;
const REPORT_DELAY_US = 2000;
const OFFSET_MAX = 2 ** 32 - 1;
const TEMPERATURE_DC = 250;
const clipCode = (code) => Math.min(Math.max(code, 0), 65535);
const modulo16 = (count) => count % 65536;

/** Firmware: what it knows is lost at a reset. hooks: log(entry), setGate(on); resetCause: as in HELLO_REPLY */
export class Board {
  constructor(settings, hooks, inputs, now, resetCause) {
    this.settings = settings;
    this.log = hooks.log;
    this.resetCause = resetCause;
    this.splitter = new Splitter();
    this.output = [];
    this.session = 0;
    this.errors = { crc_errors: 0, format_errors: 0, seq_errors: 0 };
    this.endSequence();
    this.endReports();
    this.machine = new Machine(
      settings,
      {
        log: hooks.log,
        setGate: hooks.setGate,
        move: hooks.move,
        readMirrors: hooks.readMirrors,
        send: (name, values) => this.send(name, values),
        record: (...columns) => this.record(...columns),
      },
      inputs,
      now,
    );
    this.machine.boot();
  }

  endSequence() {
    this.expectedSeq = 0;
    this.lastAnswer = "";
    this.owesAck = false;
  }

  endReports() {
    this.records = [];
    this.reported = 0;
    this.reportDue = null;
  }

  // --- time -----------------------------------------------------------------------------------------------------------

  run(now) {
    this.machine.run(now);
  }

  /** Send the reports that are due. */
  report(now) {
    while (this.records.length > this.reported) {
      const isFull = this.records.length - this.reported >= RECORDS_PER_REPORT;
      if (!isFull && now < this.reportDue) return;
      this.reported += this.sendReport(this.reported);
      this.reportDue = now + REPORT_DELAY_US;
    }
  }

  // --- from the host --------------------------------------------------------------------------------------------------

  receive(data) {
    for (const message of this.splitter.feed(data)) this.handle(message);
    if (this.owesAck) this.sendAck();
  }

  loseLink() {
    this.machine.end("link lost");
  }

  handle(message) {
    if (message.error) {
      this.errors[message.error] += 1;
      this.log({ event: "rx_error", bad_frames: this.errors.crc_errors + this.errors.format_errors });
    } else if (message.fromBoard) {
      this.errors.seq_errors += 1;
    } else if (message.name === "HELLO") {
      this.greet(message);
    } else if (message.name === "ABORT") {
      this.machine.end("abort");
    } else if (!this.session || message.frameSession !== this.session) {
      this.errors.seq_errors += 1;
    } else if (isSequenced(message.name)) {
      this.handleSequenced(message);
    } else {
      this.handleUnsequenced(message);
    }
  }

  greet({ major, host_nonce }) {
    const { machine } = this;
    machine.beginSession(major === MAJOR);
    this.endSequence();
    this.endReports();
    this.output = [];
    const last = this.session;
    while (this.session === last) this.session = randomInt(1, 65536);
    const { uid, cell_codes, cells, window_pulses, queue_points, key_edge, feedback_codes } = this.settings;
    this.send("HELLO_REPLY", {
      ...machine.limits, major: MAJOR, minor: MINOR, host_nonce, session: this.session, firmware: 1, uid,
      capabilities: (key_edge ? 1 : 0) + (feedback_codes ? 8 : 0), tick_hz: TICK_HZ, queue_points, rx_window: RX_WINDOW, cell_codes, cells,
      window_pulses, reset_cause: this.resetCause,
    });
  }

  handleUnsequenced(message) {
    const { machine } = this;
    if (message.name === "CLOCK") this.send("CLOCK_REPLY", { host_t: message.host_t, tick: machine.tick });
    if (message.name === "LEASE") machine.lease(message.ms);
    if (message.name === "GET") this.sendStatus();
    if (message.name === "GET_TRIGGERS") this.send("TRIGGERS", machine.triggers);
    if (message.name === "GET_EXECUTED") {
      const at = this.records.findIndex((record) => record.index >= message.first_index);
      if (at >= 0) this.sendReport(at);
    }
  }

  handleSequenced(message) {
    const ahead = (message.seq - this.expectedSeq) & 0xff;
    if (ahead >= BEHIND_FROM) {
      if (this.lastAnswer) this.sendNak(this.lastAnswer);
      else this.owesAck = true;
      return;
    }
    if (ahead) {
      this.errors.seq_errors += 1;
      this.sendNak("SEQUENCE");
      return;
    }
    const refused = this.carryOut(message);
    if (refused !== "NO_ROOM") {
      this.expectedSeq = (this.expectedSeq + 1) & 0xff;
      this.lastAnswer = refused;
    }
    if (refused) this.sendNak(refused);
    else this.owesAck = true;
  }

  carryOut(message) {
    const { machine } = this;
    switch (message.name) {
      case "LIMITS":
        return machine.tighten(message);
      case "DATA":
        return machine.addPoints(message.first_index, message.points);
      case "START":
        return machine.start(message);
      case "START_ON_TRIGGER":
        return machine.startOnTrigger(message);
      case "END":
        return machine.endJob(message);
      case "ARM_REQ":
        return machine.requestArming(message.host_nonce);
      case "ARM_CONFIRM":
        return machine.confirmArming(message);
      case "DISARM":
        return machine.disarm();
      case "CLEAR_FAULT":
        return machine.clearFault();
      default:
        return machine.flush();
    }
  }

  // --- to the host ----------------------------------------------------------------------------------------------------

  send(name, values) {
    if (this.session) this.output.push(encode(name, values, { session: this.session }));
  }

  takeOutput() {
    const data = Buffer.concat(this.output);
    this.output = [];
    return data;
  }

  sendAck() {
    const { machine } = this;
    this.owesAck = false;
    this.send("ACK", {
      next_seq: this.expectedSeq, free_points: machine.freePoints(), done_index: machine.doneIndex,
      state: machine.state,
    });
  }

  sendNak(reason) {
    this.send("NAK", { next_seq: this.expectedSeq, reason });
  }

  sendStatus() {
    const { machine, errors } = this;
    const inputs = (machine.inputs.interlock ? 1 : 0) + (machine.inputs.key ? 2 : 0) + (machine.inputs.estop ? 4 : 0);
    this.send("STATUS", {
      state: machine.state, fault: machine.fault, inputs, tick: machine.tick, done_index: machine.doneIndex,
      queued: machine.queue.length, crc_errors: modulo16(errors.crc_errors),
      format_errors: modulo16(errors.format_errors), seq_errors: modulo16(errors.seq_errors),
      underruns: modulo16(machine.underruns), laser_on_us: Math.floor(machine.laserOnTimesDuty / 65535),
      temperature_dc: TEMPERATURE_DC, head: 0,
      mirror_x: clipCode(machine.measured.x), mirror_y: clipCode(machine.measured.y),
    });
  }

  // --- reports --------------------------------------------------------------------------------------------------------

  record(index, tick, onTicks, duty) {
    if (this.reported === this.records.length) this.reportDue = tick + this.machine.bootUs + REPORT_DELAY_US;
    this.records.push({ index, tick, onTicks, duty });
    if (this.records.length > 2 * RECORDS_KEPT) {
      this.records.splice(0, RECORDS_KEPT);
      this.reported = Math.max(0, this.reported - RECORDS_KEPT);
    }
  }

  /** Send the records from a place on, as far as one report goes. Return their number. */
  sendReport(at) {
    const [first] = this.records.slice(at, at + 1);
    let count = 1;
    while (count < RECORDS_PER_REPORT && at + count < this.records.length) {
      const next = this.records[at + count];
      if (next.index !== first.index + count || next.tick - first.tick > OFFSET_MAX) break;
      count += 1;
    }
    this.send("EXECUTED", {
      first_index: first.index,
      base_tick: first.tick,
      records: this.records
        .slice(at, at + count)
        .map(({ tick, onTicks, duty }) => ({ offset: tick - first.tick, on_ticks: onTicks, duty })),
    });
    return count;
  }
}
