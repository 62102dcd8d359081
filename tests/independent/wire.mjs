// Framing and messages, written from PROTOCOL.md alone: "Framing" and "Messages".

const RAW_MAX = 252;
const RAW_MIN = 8;
const CODED_MAX = 253;
const RECORDS_MAX = 28;
export const POINTS_MAX = 24;
export const FRAME_MAX = 254;

export const STATES = ["BOOT", "DISARMED", "ARMING", "ARMED", "RUNNING", "HOLD", "FAULT"];
export const FAULTS = [
  "", "LINK", "RANGE", "ON_TIME", "DUTY", "MEAN_POWER", "SPOT", "UNDERRUN", "INTERLOCK", "KEY", "ESTOP", "TICK",
  "READBACK", "CELLS", "PULSES", "HEAD", "SCAN",
];
export const NAKS = ["SEQUENCE", "NO_ROOM", "STATE", "INDEX", "NONCE", "KEY_EDGE", "INPUT", "VERSION"];
export const REASONS = [
  "", "boot", "hello", "arm requested", "armed", "start", "job done", "queue empty", "refilled", "hold too long",
  "disarm", "abort", "link lost", "arming timed out", "fault", "fault cleared", "flush",
];
const ENUMERATIONS = { state: STATES, fault: FAULTS, reason: REASONS };

const LIMITS =
  "u16 max_on_us, u16 max_duty, u16 mean_duty, u32 spot_uj, u32 spot_leak_uw, u32 full_power_uw, u16 x_min, u16 x_max, " +
  "u16 y_min, u16 y_max, u16 settle_us, u16 settle_ns_per_code, u16 rest_us, u16 lease_ms";
const POINT = layout("u16 x, u16 y, u16 dark_us, u16 on_us, u16 duty");
const RECORD = layout("u32 offset, u16 on_ticks, u16 duty");

const MESSAGES = [
  message(0x01, "HELLO", "u8 major, u8 minor, u32 host_nonce"),
  message(0x02, "LIMITS", LIMITS, { sequenced: true }),
  message(0x03, "CLOCK", "u32 host_t"),
  message(0x04, "LEASE", "u16 ms"),
  message(0x10, "DATA", "u32 first_index", { sequenced: true, repeated: ["points", POINT, POINTS_MAX] }),
  message(0x11, "START", "u32 job, u32 first_index, u64 start_tick, u16 watermark", { sequenced: true }),
  message(0x12, "END", "u32 job, u32 end_index", { sequenced: true }),
  message(0x13, "ABORT", ""),
  message(0x14, "ARM_REQ", "u32 host_nonce", { sequenced: true }),
  message(0x15, "ARM_CONFIRM", "u32 host_nonce, u32 board_nonce", { sequenced: true }),
  message(0x16, "DISARM", "", { sequenced: true }),
  message(0x17, "CLEAR_FAULT", "", { sequenced: true }),
  message(0x18, "GET", ""),
  message(0x19, "FLUSH", "", { sequenced: true }),
  message(0x1a, "GET_EXECUTED", "u32 first_index"),
  message(0x1b, "START_ON_TRIGGER", "u32 job, u32 first_index, u32 delay_us, u16 wait_ms", { sequenced: true }),
  message(0x1c, "GET_TRIGGERS", ""),
  message(
    0x81,
    "HELLO_REPLY",
    "u8 major, u8 minor, u32 host_nonce, u16 session, u32 firmware, b12 uid, u32 capabilities, u32 tick_hz, " +
      "u16 queue_points, u16 rx_window, u16 cell_codes, u16 cells, u16 window_pulses, u8 reset_cause, " + LIMITS,
  ),
  message(0x83, "CLOCK_REPLY", "u32 host_t, u64 tick"),
  message(0x90, "ACK", "u8 next_seq, u16 free_points, u32 done_index, u8 state"),
  message(0x91, "NAK", "u8 next_seq, u8 reason", { enumerations: { reason: NAKS } }),
  message(0x92, "EVENT", "u8 state, u8 fault, u8 reason, u64 tick"),
  message(0x94, "ARM_CHALLENGE", "u32 host_nonce, u32 board_nonce"),
  message(
    0x98,
    "STATUS",
    "u8 state, u8 fault, u8 inputs, u64 tick, u32 done_index, u16 queued, u16 crc_errors, u16 format_errors, " +
      "u16 seq_errors, u16 underruns, u64 laser_on_us, i16 temperature_dc, u16 head, u16 mirror_x, " +
      "u16 mirror_y",
  ),
  message(0x9c, "TRIGGERS", "u32 count, u64 tick"),
  message(0x99, "EXECUTED", "u32 first_index, u64 base_tick", { repeated: ["records", RECORD, RECORDS_MAX] }),
];
const BY_NAME = new Map(MESSAGES.map((each) => [each.name, each]));
const BY_ID = new Map(MESSAGES.map((each) => [each.id, each]));

export const LIMIT_NAMES = layout(LIMITS).fields.map((field) => field.name);

const FIELD_TYPES = {
  u8: [1, (data, at) => data.readUInt8(at), (data, value, at) => data.writeUInt8(value, at)],
  u16: [2, (data, at) => data.readUInt16LE(at), (data, value, at) => data.writeUInt16LE(value, at)],
  i16: [2, (data, at) => data.readInt16LE(at), (data, value, at) => data.writeInt16LE(value, at)],
  u32: [4, (data, at) => data.readUInt32LE(at), (data, value, at) => data.writeUInt32LE(value, at)],
  u64: [
    8,
    (data, at) => Number(data.readBigUInt64LE(at)), // ticks stay below 2^53 for 285 years
    (data, value, at) => data.writeBigUInt64LE(BigInt(value), at),
  ],
  b12: [12, (data, at) => data.toString("hex", at, at + 12), (data, value, at) => data.write(value, at, "hex")],
};

function layout(text) {
  const fields = text ? text.split(", ").map((field) => field.split(" ")).map(([type, name]) => ({ type, name })) : [];
  const sizes = { u8: 1, u16: 2, i16: 2, u32: 4, u64: 8, b12: 12 };
  return { fields, size: fields.reduce((sum, field) => sum + sizes[field.type], 0) };
}

function message(id, name, text, { sequenced = false, repeated = null, enumerations = {} } = {}) {
  return { id, name, sequenced, repeated, enumerations: { ...ENUMERATIONS, ...enumerations }, ...layout(text) };
}

export const isSequenced = (name) => BY_NAME.get(name).sequenced;

// --- encoding ---------------------------------------------------------------------------------------------------------

function put(data, at, { fields }, values, enumerations = {}) {
  for (const { type, name } of fields) {
    const value = name in enumerations ? enumerations[name].indexOf(values[name]) : values[name];
    const [size, , write] = FIELD_TYPES[type];
    write(data, value, at);
    at += size;
  }
  return at;
}

/** Encode a message as a whole frame with its zero. */
export function encode(name, values, { seq = 0, session = 0 } = {}) {
  const spec = BY_NAME.get(name);
  const [list, item] = spec.repeated ?? ["", { size: 0 }];
  const items = list ? values[list] : [];
  const raw = Buffer.alloc(4 + spec.size + items.length * item.size + 4);
  raw.writeUInt8(spec.id, 0);
  raw.writeUInt8(seq, 1);
  raw.writeUInt16LE(session, 2);
  let at = put(raw, 4, spec, values, spec.enumerations);
  for (const each of items) at = put(raw, at, item, each);
  raw.writeUInt32LE(crc32(raw.subarray(0, at)), at);
  return Buffer.concat([stuff(raw), Buffer.of(0)]);
}

function stuff(raw) {
  const coded = [];
  let codeAt = coded.push(1) - 1;
  for (const byte of raw) {
    if (byte) {
      coded.push(byte);
      coded[codeAt] += 1;
    } else {
      codeAt = coded.push(1) - 1;
    }
  }
  return Buffer.from(coded);
}

// --- decoding ---------------------------------------------------------------------------------------------------------

function unstuff(coded) {
  const raw = [];
  for (let at = 0; at < coded.length; ) {
    const code = coded[at];
    if (code === 0xff || at + code > coded.length) return null;
    for (let k = 1; k < code; k++) raw.push(coded[at + k]);
    at += code;
    if (at < coded.length) raw.push(0);
  }
  return Buffer.from(raw);
}

function take(data, at, { fields }, enumerations = {}) {
  const values = {};
  for (const { type, name } of fields) {
    const [size, read] = FIELD_TYPES[type];
    values[name] = read(data, at);
    if (name in enumerations) {
      values[name] = enumerations[name][values[name]];
      if (values[name] === undefined) return null;
    }
    at += size;
  }
  return values;
}

/** Decode a piece between two zeros: {name, seq, session, fromBoard, ...fields}, or {error} that names the counter. */
export function decode(coded) {
  const raw = unstuff(coded);
  if (!raw || raw.length > RAW_MAX || raw.length < RAW_MIN) return { error: "format_errors" };
  const end = raw.length - 4;
  if (raw.readUInt32LE(end) !== crc32(raw.subarray(0, end))) return { error: "crc_errors" };
  const spec = BY_ID.get(raw[0]);
  if (!spec) return { error: "format_errors" };
  const rest = end - 4 - spec.size;
  const [list, item, most] = spec.repeated ?? ["", { size: 1 }, 0];
  const count = rest / item.size;
  if (!Number.isInteger(count) || count > most || count < Math.min(most, 1)) return { error: "format_errors" };
  const values = take(raw, 4, spec, spec.enumerations);
  if (!values) return { error: "format_errors" };
  if (list) values[list] = Array.from({ length: count }, (_, k) => take(raw, 4 + spec.size + k * item.size, item));
  return { ...values, name: spec.name, seq: raw[1], frameSession: raw.readUInt16LE(2), fromBoard: raw[0] >= 0x80 };
}

/** Splits a stream at zeros with bounded memory. */
export class Splitter {
  #piece = [];
  #tooLong = false;

  /** Yield the decoded pieces that these bytes complete; one that is too long counts when it becomes so. */
  *feed(data) {
    for (const byte of data) {
      if (byte === 0) {
        const piece = this.#piece;
        const skipped = this.#tooLong;
        this.#piece = [];
        this.#tooLong = false;
        if (!skipped && piece.length) yield decode(Buffer.from(piece));
      } else if (!this.#tooLong) {
        this.#piece.push(byte);
        if (this.#piece.length > CODED_MAX) {
          this.#tooLong = true;
          yield { error: "format_errors" };
        }
      }
    }
  }
}

// --- CRC --------------------------------------------------------------------------------------------------------------

const TABLE = Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value >>> 0;
});

function crc32(data) {
  let value = 0xffffffff;
  for (const byte of data) value = TABLE[(value ^ byte) & 0xff] ^ (value >>> 8);
  return (value ^ 0xffffffff) >>> 0;
}
