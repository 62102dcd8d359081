// The computer at the Pico's USB port: rp2040js's host of a virtual serial port enumerates the device. Beside it stands what the
// emulator's bus leaves out: frames, the time of a packet, a computer that sends nothing, does not read, sleeps or is gone, the
// numbers of packets (DATA0, DATA1), a refused request, and the controller's slower clock.

const FRAME_NANOS = 1e6;
const PACKET_NANOS = 52_632; // 19 full packets in a frame
const PACKET = 64, CONTROL = 0, DATA = 2, OUT = 1;
const AVAILABLE = 1 << 10, STALL = 1 << 11, DATA1 = 1 << 13, FIRST = 0x80, LAST = 0xfc;
const CLEAR_FEATURE = 1, SET_CONFIGURATION = 9, DTR_RTS = 3;
const at = (endpoint, way) => FIRST + 8 * endpoint + 4 * way;

// The emulator's PLL oscillates at any frequency; the chip's at 750 to 1600 MHz.
function checkClock({ frequency, postdiv1, postdiv2 }) {
  const oscillator = frequency * postdiv1 * postdiv2;
  if (frequency !== 48e6 || oscillator < 750e6 || oscillator > 1600e6) throw new Error(`USB: ${frequency} of ${oscillator} Hz`);
}

export class UsbHost {
  // state: { connected, awake, open, reads } of the computer, which outlives a reset of the chip; emit: takes records
  constructor(rp2040, USBCDC, state, emit) {
    const usb = rp2040.usbCtrl, { clock } = rp2040;
    Object.assign(this, { usb, pll: rp2040.pllUsb, USBCDC, state, emit, memory: rp2040.usbDPRAMView });
    this.toSend = [];
    this.request = []; // data of a control request
    this.written = new Map(); // buffer control words
    this.expected = new Map(); // number of the next packet
    this.armed = { in: false, out: false };
    this.frame = 0;
    this.frames = clock.createAlarm(() => this.beginFrame());
    this.slot = clock.createAlarm(() => this.carryPacket());
    this.waiting = false;
    this.carry = usb.DPRAMUpdated.bind(usb);
    usb.DPRAMUpdated = (offset, value) => this.onWritten(offset, value);
    this.sendSetup = usb.sendSetupPacket.bind(usb);
    usb.sendSetupPacket = (setup) => this.onSetup(setup);
    usb.writeDelayMicroseconds = 0;
    this.meet();
    this.frames.schedule(FRAME_NANOS);
  }

  // A computer that has not met the device yet.
  meet() {
    this.counts = true;
    const { usb } = this, cdc = (this.cdc = new this.USBCDC(usb));
    const setLines = cdc.cdcSetControlLineState.bind(cdc), onControl = usb.onEndpointWrite;
    cdc.cdcSetControlLineState = () => setLines(this.state.open ? DTR_RTS : 0);
    usb.onUSBEnabled = () => {
      checkClock(this.pll);
      if (this.state.connected) usb.resetDevice();
    };
    usb.onEndpointWrite = (endpoint, bytes) => {
      if (endpoint === DATA) this.emit("usb", Buffer.from(bytes).toString("hex"));
      else if (cdc.initialized) this.emit("control", Buffer.from(bytes).toString("hex"));
      else onControl(endpoint, bytes);
    };
    usb.onEndpointRead = (endpoint) => {
      if (endpoint === DATA) this.armed.out = true;
      else if (this.request.length) usb.endpointReadDone(CONTROL, Uint8Array.from(this.request.splice(0)), 0);
      this.wake();
    };
  }

  // --- what the computer does ---

  plug() {
    this.state.connected = this.state.awake = true;
    this.toSend = [];
    this.request = [];
    this.meet();
    this.usb.resetDevice();
  }
  unplug() { this.state.connected = this.state.open = false; }
  suspend() { this.state.awake = false; }
  resume() {
    this.state.awake = true;
    this.wake();
  }
  reset() {
    this.usb.onResetReceived = () => {}; // and asks for nothing
    this.usb.resetDevice();
  }
  open() {
    this.state.open = true;
    if (this.cdc.initialized) this.cdc.cdcSetControlLineState();
    this.wake();
  }
  close() {
    this.state.open = false;
    this.toSend = [];
    if (this.cdc.initialized) this.cdc.cdcSetControlLineState();
  }
  read(reads) {
    this.state.reads = reads;
    this.wake();
  }
  bytes(hex) {
    this.toSend.push(...Buffer.from(hex, "hex"));
    this.wake();
  }
  control(setup, data) {
    this.request = [...Buffer.from(data, "hex")];
    this.usb.sendSetupPacket(Buffer.from(setup, "hex"));
  }

  // A request that no computer sends: what follows need not count right until the next plug().
  nonsense(setup, data) {
    this.counts = false;
    this.control(setup, data);
  }

  // --- the bus ---

  get isAlive() { return this.state.connected && this.state.awake; }

  beginFrame() {
    if (this.isAlive) this.usb.sofFrameNumber = this.frame = (this.frame + 1) & 0x7ff;
    this.frames.schedule(FRAME_NANOS);
  }

  onSetup(setup) {
    this.expected.set(at(CONTROL, 0), 1).set(at(CONTROL, OUT), 1);
    if (setup[1] === SET_CONFIGURATION) this.expected.set(at(DATA, 0), 0).set(at(DATA, OUT), 0);
    if (setup[1] === CLEAR_FEATURE) this.expected.set(at(setup[4] & 15, setup[4] & 0x80 ? 0 : OUT), 0);
    this.sendSetup(setup);
  }

  onWritten(offset, value) {
    if (offset < FIRST || offset > LAST) return;
    const before = this.written.get(offset), isOut = (offset & 4) !== 0, endpoint = (offset - FIRST) >> 3;
    this.written.set(offset, value);
    if (value & STALL && offset === at(CONTROL, 0)) this.emit("stall");
    if (endpoint === DATA) this.armed[isOut ? "out" : "in"] = false;
    if (!(value & AVAILABLE)) return;
    if (before !== (value & ~AVAILABLE)) throw new Error("USB: a buffer became available together with its length");
    const counted = Boolean(value & DATA1) === Boolean(this.expected.get(offset));
    if (this.counts && !counted) throw new Error(`USB: number of a packet at ${offset}`);
    if (endpoint === DATA && !isOut) this.armed.in = true;
    else {
      if (endpoint === CONTROL) this.count(offset);
      this.carry(offset, value);
    }
    this.wake();
  }

  count(offset) { this.expected.set(offset, 1 - this.expected.get(offset)); }

  get hasWork() {
    const { armed, state } = this;
    return this.isAlive && ((armed.out && this.toSend.length > 0) || (armed.in && state.open && state.reads));
  }

  wake() {
    if (this.waiting || !this.hasWork) return;
    this.waiting = true;
    this.slot.schedule(PACKET_NANOS);
  }

  carryPacket() {
    this.waiting = false;
    if (!this.hasWork) return;
    const { armed, state } = this, sends = armed.out && this.toSend.length > 0 && !(this.sentLast && armed.in && state.reads);
    this.sentLast = sends;
    if (sends) {
      armed.out = false;
      this.count(at(DATA, OUT));
      this.usb.endpointReadDone(DATA, Uint8Array.from(this.toSend.splice(0, PACKET)), 0);
    } else {
      armed.in = false;
      this.count(at(DATA, 0));
      this.carry(at(DATA, 0), this.memory.getUint32(at(DATA, 0), true));
    }
    this.wake();
  }
}
