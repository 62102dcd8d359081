// Marks panels whose figures are old: what fills them has not arrived for a while.

const LIMIT_MS = 2000; // of events that come at least once per second
const CHECK_MS = 250;
const TIME = new Intl.DateTimeFormat(undefined, { timeStyle: "medium", hourCycle: "h23" });

export class Freshness {
  // panels: source of figures → the panels that it fills
  // onStale(source): called once when a source becomes stale
  constructor(panels, onStale) {
    this.onStale = onStale;
    this.sources = new Map(
      Object.entries(panels).map(([source, elements]) => [source, { at: null, isStale: false, marks: elements.map(createMark) }]),
    );
    setInterval(() => this.#check(), CHECK_MS);
  }

  // Note that figures of a source have arrived.
  see(source) {
    const entry = this.sources.get(source);
    entry.at = Date.now();
    if (entry.isStale) {
      this.#setStale(entry, false);
    }
  }

  // Mark sources at once: all if the daemon is gone.
  lose(sources = [...this.sources.keys()]) {
    for (const source of sources) {
      const entry = this.sources.get(source);
      if (!entry.isStale) {
        this.#setStale(entry, true);
        this.onStale(source);
      }
    }
  }

  isStale(source) {
    return this.sources.get(source).isStale;
  }

  #check() {
    for (const [source, entry] of this.sources) {
      if (entry.at !== null && !entry.isStale && Date.now() - entry.at > LIMIT_MS) {
        this.#setStale(entry, true);
        this.onStale(source);
      }
    }
  }

  #setStale(entry, isStale) {
    entry.isStale = isStale;
    for (const { panel, mark } of entry.marks) {
      panel.toggleAttribute("data-stale", isStale);
      mark.hidden = !isStale;
      mark.textContent = !isStale ? "" : entry.at === null ? "no data" : `stale since ${TIME.format(entry.at)}`;
    }
  }
}

function createMark(panel) {
  const mark = Object.assign(document.createElement("p"), { className: "stale-mark", hidden: true });
  panel.append(mark);
  return { panel, mark };
}
