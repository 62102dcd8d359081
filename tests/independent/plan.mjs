// What the client plays: a rosette, then four dots three times with pauses; and its check against the board's limits.

const CENTRE = 32768;
const PETALS = 5;
const ROSETTE = 240;
const DOTS = [[-6000, -6000], [6000, -6000], [6000, 6000], [-6000, 6000]];
const ROUNDS = 3;
const PAUSE_US = 200_000;
const DARK_MAX_US = 65_535;
const SECOND_US = 1_000_000;

function rosette() {
  return Array.from({ length: ROSETTE }, (_, k) => {
    const angle = (2 * Math.PI * k) / ROSETTE;
    const radius = 9000 + 6000 * Math.cos(PETALS * angle);
    return {
      x: Math.round(CENTRE + radius * Math.cos(angle)),
      y: Math.round(CENTRE + radius * Math.sin(angle)),
      dark_us: 300 + 7 * (k % 11),
      on_us: k % 12 === 11 ? 0 : 400 + k, // every twelfth point is dark
      duty: 20_000 + 37 * k,
    };
  });
}

function dots() {
  return Array.from({ length: ROUNDS }, (_, round) => [
    ...DOTS.map(([x, y], k) => ({
      x: CENTRE + x, y: CENTRE + y, dark_us: 0, on_us: 2000 + 100 * k + round, duty: 30_000,
    })),
    ...pause(PAUSE_US, { x: CENTRE + DOTS[3][0], y: CENTRE + DOTS[3][1] }),
  ]).flat();
}

/** Return a pause of any length, of several points where one cannot be as long. */
function pause(durationUs, place) {
  const points = [];
  for (let rest = durationUs; rest > 0; rest -= DARK_MAX_US) {
    points.push({ ...place, dark_us: Math.min(rest, DARK_MAX_US), on_us: 0, duty: 0 });
  }
  return points;
}

export const JOBS = [rosette(), dots()];

/** Refuse points that the board would not emit, by bounds that need no account of heat that has left. */
export function checkPlan(points, board) {
  const refuse = (what) => {
    throw new Error(`the board does not permit this plan: ${what}`);
  };
  points.forEach(({ x, y, on_us, duty }, k) => {
    if (x < board.x_min || x > board.x_max || y < board.y_min || y > board.y_max) refuse(`point ${k} is off its field`);
    if (on_us > board.max_on_us) refuse(`point ${k} is on for ${on_us} µs of ${board.max_on_us}`);
    if (duty > board.max_duty) refuse(`point ${k} has duty ${duty} of ${board.max_duty}`);
  });
  const pulses = points.filter((point) => point.on_us);
  if (pulses.length > board.window_pulses) refuse(`${pulses.length} pulses of ${board.window_pulses} in a second`);
  if (pulses.length > board.cells) refuse(`${pulses.length} places of ${board.cells}`);
  const onTimesDuty = pulses.reduce((sum, { on_us, duty }) => sum + on_us * duty, 0);
  if (onTimesDuty > SECOND_US * board.mean_duty) refuse("its mean power");
  for (const one of pulses) {
    const near = pulses.filter(
      ({ x, y }) => Math.abs(x - one.x) < board.cell_codes && Math.abs(y - one.y) < board.cell_codes,
    );
    const onUs = near.reduce((sum, { on_us }) => sum + on_us, 0);
    const uj = near.reduce((sum, { on_us, duty }) => sum + (on_us * duty * board.full_power_uw) / 65535 / 1e6 + 1, 0);
    if (onUs > board.max_on_us) refuse(`${onUs} µs within a cell of ${board.max_on_us}`);
    if (uj > board.spot_uj) refuse(`${Math.ceil(uj)} µJ within a cell of ${board.spot_uj}`);
  }
}
