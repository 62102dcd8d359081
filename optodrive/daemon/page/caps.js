// Labels of the caps, by the key that plans and telemetry use; the configuration states them.

const LABELS = {};

export function setCapLabels(caps) {
  for (const [key, { label }] of Object.entries(caps)) {
    LABELS[key] = label;
  }
}

export function labelCap(key) {
  return LABELS[key] ?? key;
}
