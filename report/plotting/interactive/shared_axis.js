// An abscissa that several panels have in common: they zoom together, and have one cursor.

const groups = new Map();
/** The panels with one abscissa: they zoom together, and have one cursor. */
class Group {
  constructor(axis) { this.axis = axis; this.panels = new Set(); Object.assign(this, axisLimits(axis)); }
  get zoomed() { return this.min !== this.axis.low || this.max !== this.axis.high; }
  zoom(min, max) {
    const a = toScale(this.axis, this.axis.low), b = toScale(this.axis, this.axis.high);
    let lo = toScale(this.axis, min), hi = toScale(this.axis, max);
    if (!(hi - lo > 1e-9 * (b - a))) return;
    if (lo < a) { hi = Math.min(hi + a - lo, b); lo = a; }
    if (hi > b) { lo = Math.max(lo - (hi - b), a); hi = b; }
    this.min = lo <= a ? this.axis.low : fromScale(this.axis, lo);
    this.max = hi >= b ? this.axis.high : fromScale(this.axis, hi);
    this.changed();
  }
  /** Zoom by a factor about an abscissa. */
  scale(factor, about) {
    const lo = toScale(this.axis, this.min), hi = toScale(this.axis, this.max), c = toScale(this.axis, about);
    this.zoom(fromScale(this.axis, c - (c - lo) * factor), fromScale(this.axis, c + (hi - c) * factor));
  }
  shift(share) {
    const lo = toScale(this.axis, this.min), hi = toScale(this.axis, this.max), d = share * (hi - lo);
    this.zoom(fromScale(this.axis, lo + d), fromScale(this.axis, hi + d));
  }
  reset() { Object.assign(this, axisLimits(this.axis)); this.changed(); }
  changed() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; for (const panel of this.panels) panel.update(); });
  }
  cursor(x, from) { for (const panel of this.panels) panel.showCursor(x, panel === from); }
}
