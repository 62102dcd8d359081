// Quantities with a prefix that keeps their number short.

const PREFIXES = [[1, ""], [1e-3, "m"], [1e-6, "µ"]];

// Format an SI value with three significant digits at least: 41.5 J, 8.10 J, 320 mJ.
export function formatQuantity(value, unit) {
  const [scale, prefix] = PREFIXES.find(([each]) => Math.abs(value) >= each) ?? (value === 0 ? PREFIXES[0] : PREFIXES.at(-1));
  const number = value / scale;
  const digits = value === 0 ? 0 : Math.max(0, 2 - Math.floor(Math.log10(Math.abs(number))));
  return `${number.toFixed(digits)} ${prefix}${unit}`;
}
