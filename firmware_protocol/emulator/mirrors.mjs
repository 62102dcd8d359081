// Mirrors that follow at once, and their position outputs at the ADC, with noise and a disturbed reading now and then.

const CENTRE = 32768;
const CODES_PER_STEP = 19.556, CENTRE_STEP = 2048, STEP_MAX = 4095; // 1.65 ± 1.35 V for codes 0 to 65535
const NOISE_STEPS = 6; // ±: half of the ADC's effective resolution
const DISTURBED = 61; // one in as many readings, of both axes, at either end of the range
const SLOW_NANOS = 20_000_000;

export class Mirrors {
  // fault: {name, stuck}, which outlasts a reset; random: returns 32 bits
  constructor(rp2040, fault, random) {
    const { adc, clock } = rp2040;
    Object.assign(this, { fault, random, clock, at: [CENTRE, CENTRE], before: [CENTRE, CENTRE], moved: 0, reads: 0 });
    // The emulator keeps bits 2 and 3 of the input's number in place of its three.
    Object.defineProperty(adc, "activeChannel", {
      get: () => (adc.cs >> 12) & 7,
      set: (channel) => { adc.cs = (adc.cs & ~(7 << 12)) | ((channel & 7) << 12); },
    });
    const read = adc.onADCRead;
    adc.onADCRead = (channel) => {
      if (channel < 2) adc.channelValues[channel] = this.readStep(channel);
      read(channel);
    };
  }

  moveTo(x, y) {
    [this.before, this.at, this.moved] = [this.at, [x, y], this.clock.nanos];
  }

  inject(name) {
    this.before = [this.code(0), this.code(1)]; // slow from the next move on
    Object.assign(this.fault, { name, stuck: this.before[0] });
  }

  code(axis) {
    const { name, stuck } = this.fault;
    if (axis === 0 && name === "stick_mirror") return stuck;
    if (axis === 0 && name === "slow_mirror" && this.clock.nanos < this.moved + SLOW_NANOS) return this.before[0];
    return this.at[axis];
  }

  readStep(axis) {
    if (axis === 0 && this.fault.name === "unplug_mirror") return STEP_MAX; // its pull-up
    const drawn = this.random();
    if (this.reads++ % DISTURBED === 0) return drawn & 1024 ? STEP_MAX : 0;
    const noise = ((drawn >>> 8) % (2 * NOISE_STEPS + 1)) - NOISE_STEPS;
    return Math.min(Math.max(Math.round(CENTRE_STEP + (this.code(axis) - CENTRE) / CODES_PER_STEP) + noise, 0), STEP_MAX);
  }
}
