// One panel of a chart: curves by uPlot, marks, zoom, cursor and readings.

const NARROW_PX = 700, FONT = "11px system-ui, sans-serif", Y_AXIS_PX = 54, Y_LABEL_PX = 16;
const WHEEL = 0.0025, ZOOM_KEY = 1.5, MARKERS_MOST = 4000;

const element = (tag, className, parent, text) => {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
};

class PanelView {
  constructor(figure, panel) {
    this.figure = figure; this.panel = panel; this.y = axisLimits(panel.y);
    const key = panel.x.key;
    if (!groups.has(key)) groups.set(key, new Group(panel.x));
    this.group = groups.get(key); this.group.panels.add(this);
    this.root = element("div", "panel", figure.grid);
    this.root.style.gridRow = panel.row + 1; this.root.style.gridColumn = panel.column + 1;
    const head = element("div", "panel-head", this.root);
    if (panel.y.label) head.style.paddingLeft = `${Y_AXIS_PX + Y_LABEL_PX}px`;
    element("b", "", head, panel.title);
    if (panel.legend.length) figure.legendButtons(panel.legend, element("span", "legend", head));
    element("span", "unit", head, panel.right);
    this.plot = element("div", "plot", this.root);
    this.plot.tabIndex = 0; this.plot.setAttribute("role", "application");
    this.plot.setAttribute("aria-label", `${panel.title || figure.name}: arrow keys read values, plus and minus zoom, Escape resets`);
    this.plot.addEventListener("keydown", (event) => this.key(event));
    this.box = element("div", "readout", this.plot); this.box.hidden = true;
  }

  get narrow() { return this.figure.narrow; }
  get height() {
    const labelled = this.panel.x.labelled || (this.narrow && this.panel.series.length);
    return Math.round(Math.max(this.panel.height, this.panel.series.length ? 112 : 0)) + (labelled ? 34 : 8) + (this.panel.x.label && labelled ? 12 : 0);
  }
  get width() { return Math.max(Math.floor(this.root.clientWidth), 120); }

  start() {
    const { panel } = this;
    this.drawn = [];  // for each of uPlot's series after the first: the series and which edge
    const series = [{}], bands = [];
    panel.series.forEach((s) => {
      const two = s.kind === "band" || (s.kind === "line" && (s.low !== s.high || s.x.length > ALL_POINTS));
      const hidden = () => colour("paper") + "00";
      const stroke = s.kind !== "line" || s.look.width === 0 ? hidden : () => colour(s.look.colour);
      const make = (edge) => {
        this.drawn.push({ s, edge });
        series.push({
          stroke, width: s.kind === "line" ? s.look.width : 1, alpha: s.kind === "line" ? s.look.alpha : 1, dash: s.look.dash,
          points: { show: false }, spanGaps: false,
          ...(s.kind === "steps" ? { paths: uPlot.paths.stepped({ align: 1 }), fill: () => faded(s.look.colour, s.look.alpha) } : {}),
          ...(s.kind === "steps" && panel.y.log ? { fillTo: panel.y.low } : {}),
        });
        return series.length - 1;
      };
      if (two) {
        const high = make("high"), low = make("low");
        bands.push({ series: [high, low], fill: () => faded(s.look.colour, s.kind === "band" ? s.look.alpha : 1) });
      } else make("low");
    });
    const scale = (axis, limits) => ({
      time: false, distr: axis.log ? 3 : 1, dir: axis.inverted ? -1 : 1,
      range: () => { const { min, max } = limits(); return [min, max]; },
    });
    this.u = new uPlot({
      width: this.width, height: this.height, padding: [6, 10, 0, 0], legend: { show: false },
      cursor: {
        y: false, points: { show: false }, drag: { x: true, y: true, uni: 24, setScale: false },
        bind: {
          dblclick: () => () => this.reset(),
          mousedown: (u, target, handle) => (event) => { if (event.shiftKey) this.pan(event); else handle(event); },
        },
      },
      scales: { x: scale(panel.x, () => this.group), y: scale(panel.y, () => this.y) },
      axes: [this.axis(panel.x, true), this.axis(panel.y, false)],
      series, bands,
      hooks: {
        drawClear: [() => this.marks("rectangle")],
        drawAxes: [() => this.marks("segments")],
        draw: [() => { this.curves = null; this.markers(); this.marks("note"); }],
        setSelect: [(u) => this.select(u)],
        setCursor: [(u) => { if (!this.quiet) this.group.cursor(u.cursor.left < 0 ? null : u.posToVal(u.cursor.left, "x"), this); }],
      },
    }, this.data(), this.plot);
    this.u.over.append(this.box);
    this.touch(this.u.over);
    this.u.over.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      this.group.scale(Math.exp(WHEEL * Math.max(-200, Math.min(200, event.deltaY)) * 2), this.at(event.clientX));
    }, { passive: false });
  }

  axis(axis, isX) {
    const most = (u) => (isX ? Math.max(2, Math.min(8, u.over.clientWidth / 60 || this.width / 75)) : Math.max(2, Math.min(6, (u.over.clientHeight || Math.max(this.panel.height, 112)) / 26)));
    let found = { at: [] };
    const shown = () => !isX || axis.labelled || (this.narrow && this.panel.series.length > 0);
    const label = isX ? (axis.label ? axis.label + (axis.unit ? ` [${axis.unit}]` : "") : "") : axis.label;
    const bare = !isX && axis.ticks.length === 0 && this.panel.series.length === 0;
    return {
      font: FONT, labelFont: FONT, stroke: () => colour("muted"), gap: 4, label: undefined,
      grid: { stroke: () => colour("grid"), width: 1, show: !bare && (isX ? this.panel.series.length > 0 : true) },
      ticks: { stroke: () => colour("edge"), width: 1, size: 4, show: shown() },
      border: { show: !bare && this.panel.series.length > 0, stroke: () => colour("edge"), width: 1 },
      size: isX ? () => (shown() ? 24 : 6) : Y_AXIS_PX,
      splits: (u, _, min, max) => { found = bare ? { at: [] } : ticks(axis, min, max, most(u)); return found.at; },
      values: (u, splits) => splits.map((v) => (shown() ? tickText(found, isX, v) : "")),
      filter: (u, splits) => splits,
      ...(label ? { label: isX && !shown() ? undefined : label, labelSize: isX ? (shown() ? 18 : 0) : Y_LABEL_PX, labelGap: 0 } : {}),
    };
  }

  /** Return uPlot's data in the visible range, at the resolution of the screen. */
  data() {
    const { min, max } = this.group, px = this.u?.over.clientWidth || this.width;
    const tables = [], order = [];
    this.views = new Map();
    for (const s of this.panel.series) {
      const view = visible(s, min, max, px);
      this.views.set(s, view);
      let table = tables.find((t) => t.level.x === view.level.x && t.a === view.a && t.b === view.b);
      if (!table) tables.push((table = { level: view.level, a: view.a, b: view.b, columns: [] }));
    }
    const plain = (values, a, b) => Array.from(values.subarray(a, b), (v) => (Number.isNaN(v) ? null : v));
    this.drawn.forEach(({ s, edge }, index) => {
      const view = this.views.get(s);
      const table = tables.find((t) => t.level.x === view.level.x && t.a === view.a && t.b === view.b);
      table.columns.push(index);
      order[index] = plain(view.level[edge], view.a, view.b);
    });
    const used = tables.filter((t) => t.columns.length);
    if (!used.length) return [[min, max]];
    const all = used.map((t) => [Array.from(t.level.x.subarray(t.a, t.b)), ...t.columns.map((c) => order[c])]);
    // Mode 2: a missing value stays a gap up to the neighbouring values, whatever other curves have between them.
    const whole = all.length > 1 ? uPlot.join(all, all.map((t) => t.map(() => 2))) : all[0];
    const out = [whole[0]];
    used.flatMap((t) => t.columns).forEach((column, k) => { out[column + 1] = whole[k + 1]; });
    return out;
  }

  update() {
    if (!this.u) return;
    const data = this.data();
    this.u.batch(() => {
      this.drawn.forEach(({ s }, k) => {
        const on = this.figure.shows(s.entry);
        if (this.u.series[k + 1].show !== on) this.u.setSeries(k + 1, { show: on }, false);
        if (s.kind === "line") {
          const band = this.samplesAt(s, (this.group.min + this.group.max) / 2).samples > 1;
          this.u.series[k + 1].width = band ? 0.7 : s.look.width;
        }
      });
      this.u.setData(data, false);
      this.u.setScale("x", { min: this.group.min, max: this.group.max });
      this.u.setScale("y", this.y);
    });
    this.figure.status();
  }

  /** Return how many samples, and how much time, a drawn bin of a series holds at an abscissa. */
  samplesAt(s, x) {
    const row = Math.max(search(s.x, x) - 1, 0);
    let found = s.starts[0];
    for (const start of s.starts) if (start[0] <= row) found = start; else break;
    const [, count, step] = found, samples = Math.max(count, this.views.get(s).level.samples);
    return { samples, time: (step * samples) / count, stored: count };
  }

  resize() { this.u?.setSize({ width: this.width, height: this.height }); this.update(); }
  redraw() { this.u?.redraw(false); }
  reset() { this.y = axisLimits(this.panel.y); this.group.reset(); this.figure.status(); }
  get zoomed() { return this.group.zoomed || this.y.min !== this.panel.y.low || this.y.max !== this.panel.y.high; }

  select(u) {
    const { left, top, width, height } = u.select;
    if (width < 2 && height < 2) return;
    if (height > 0 && height < u.over.clientHeight - 1) {
      const a = u.posToVal(top, "y"), b = u.posToVal(top + height, "y");
      this.y = { min: Math.min(a, b), max: Math.max(a, b) };
    }
    const whole = width <= 0 || width >= u.over.clientWidth - 1;
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (whole) this.group.changed();
    else this.group.zoom(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
  }
  at(clientX) { const r = this.u.over.getBoundingClientRect(); return this.u.posToVal(clientX - r.left, "x"); }

  pan(event) {
    event.preventDefault();
    let last = event.clientX;
    const move = (e) => { this.group.shift((last - e.clientX) / this.u.over.clientWidth); last = e.clientX; };
    const end = () => { removeEventListener("mousemove", move); removeEventListener("mouseup", end); };
    addEventListener("mousemove", move); addEventListener("mouseup", end);
  }

  /** One finger reads values, two fingers zoom. */
  touch(over) {
    const fingers = new Map();
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.max(Math.abs(a - b), 10); };
    over.addEventListener("pointerdown", (e) => { if (e.pointerType === "touch") fingers.set(e.pointerId, e.clientX); });
    over.addEventListener("pointermove", (e) => {
      if (!fingers.has(e.pointerId)) return;
      const before = fingers.size === 2 ? spread() : 0;
      fingers.set(e.pointerId, e.clientX);
      if (fingers.size === 2) {
        const [a, b] = [...fingers.values()];
        this.group.scale(before / spread(), this.at((a + b) / 2));
      } else this.group.cursor(this.at(e.clientX), this);
    });
    for (const name of ["pointerup", "pointercancel"]) over.addEventListener(name, (e) => fingers.delete(e.pointerId));
  }

  key(event) {
    const { key } = event, width = this.u.over.clientWidth;
    const middle = this.x ?? fromScale(this.panel.x, (toScale(this.panel.x, this.group.min) + toScale(this.panel.x, this.group.max)) / 2);
    if (key === "Escape" || key === "0" || key === "Home") this.reset();
    else if (key === "+" || key === "=") this.group.scale(1 / ZOOM_KEY, middle);
    else if (key === "-") this.group.scale(ZOOM_KEY, middle);
    else if ((key === "ArrowLeft" || key === "ArrowRight") && event.shiftKey) this.group.shift(key === "ArrowLeft" ? -0.2 : 0.2);
    else if (key === "ArrowLeft" || key === "ArrowRight") {
      const left = Math.max(0, Math.min(width, this.u.valToPos(middle, "x") + (key === "ArrowLeft" ? -1 : 1) * Math.max(width / 200, 1)));
      this.group.cursor(this.u.posToVal(left, "x"), this);
    } else return;
    event.preventDefault();
  }

  // ---- reading values
  showCursor(x, own) {
    if (!this.u) return;
    this.x = x;
    if (x === null) { this.box.hidden = true; }
    if (!own || (x !== null && Math.abs(this.u.posToVal(this.u.cursor.left, "x") - x) > 0)) {
      this.quiet = true;
      this.u.setCursor({ left: x === null ? -10 : this.u.valToPos(x, "x"), top: x === null ? -10 : 0 }, false);
      this.quiet = false;
    }
    if (x === null) return;
    const lines = this.readings(x);
    this.box.replaceChildren();
    const { panel } = this;
    const precision = (this.group.max - this.group.min) / Math.max(this.u.over.clientWidth, 1);
    const where = lines.find((l) => l.x !== undefined)?.x ?? x;
    const decimals = panel.x.log ? null : Math.max(0, Math.min(6, Math.ceil(-Math.log10(precision))));
    const at = decimals === null ? String(Number(where.toPrecision(4))) : where.toFixed(decimals);
    element("div", "at", this.box, `${minus(at)} ${panel.x.unit}`);
    for (const { entry, look, label, text } of lines) {
      const line = element("div", "", this.box);
      line.append(swatch(look, entry?.area));
      const name = label || "";
      if (name && own) element("span", "name", line, name);
      element("span", "value", line, text);
    }
    this.box.hidden = lines.length === 0;
    const left = this.u.valToPos(x, "x"), whole = this.u.over.clientWidth, wide = this.box.offsetWidth;
    const place = freePlace(this, left, wide, this.box.offsetHeight);
    // Without a free place the panel with the cursor shows its values beneath; others show none.
    this.box.hidden ||= !place && !own;
    const { x: beside, y: top } = place ?? { x: Math.max(0, Math.min(left + 10, whole - wide)), y: this.u.over.clientHeight + 4 };
    this.box.style.left = `${beside}px`;
    this.box.style.top = `${top}px`;
  }

  readings(x) {
    const { panel, figure } = this, out = [];
    const bands = new Map();
    for (const s of panel.series) {
      if (!figure.shows(s.entry)) continue;
      const { level } = this.views.get(s);
      let i = search(level.x, x);
      const binned = s.kind === "steps" || this.samplesAt(s, x).samples > 1;
      if (binned) i = level.x[i] === x ? i : i - 1;
      else if (i > 0 && (i === level.x.length || x - level.x[i - 1] < level.x[i] - x)) i -= 1;
      if (i < 0 || i >= level.x.length) continue;
      if (Number.isNaN(level.low[i]) && i > 0 && level.x[i] === level.x[i - 1]) i -= 1;
      const far = level.x.length > 1 ? 3 * stepOf(level.x) : Infinity;
      if (!panel.x.log && !binned && Math.abs(level.x[i] - x) > far) continue;
      const low = level.low[i], high = level.high[i];
      if (Number.isNaN(low)) continue;
      // Digits beyond the stored step, or far below what the panel shows, say nothing.
      const step = panel.y.log ? Math.abs(low) * Math.max(10 ** s.step - 1, 5e-4) : Math.max(s.step, (this.y.max - this.y.min) / 5000);
      const unit = panel.y.unit ? ` ${panel.y.unit}` : "";
      const entry = s.entry === null ? null : figure.chart.entries[s.entry];
      const text = low === high ? number(low, step) : `${number(low, step)} … ${number(high, step)}`;
      if (s.kind === "band") { bands.set(s.entry, `${number(low, step)} … ${number(high, step)}`); continue; }
      out.push({ id: s.entry, entry, look: s.look, label: s.label || panel.title, text, unit, x: binned ? undefined : level.x[i] });
    }
    // The band of an entry is that of its strongest line: paler ones are another model's.
    const strength = (line) => line.look.alpha;
    for (const line of out) {
      const strongest = !out.some((other) => other.id === line.id && strength(other) > strength(line));
      const band = line.id === null || !strongest ? undefined : bands.get(line.id);
      line.text += (band ? ` (${band})` : "") + line.unit;
    }
    for (const m of panel.marks)
      if (m.mark === "rectangle" && !m.x_share && m.entry !== null && !panel.series.length && m.x[0] <= x && x < m.x[1])
        out.push({ entry: figure.chart.entries[m.entry], look: m.look, label: "", text: figure.chart.entries[m.entry].label });
    return out;
  }

  // ---- drawing what uPlot does not
  marks(kind) {
    const { u } = this, { ctx, bbox } = u, dpr = devicePixelRatio;
    ctx.save(); ctx.beginPath(); ctx.rect(bbox.left, bbox.top - 30 * dpr, bbox.width, bbox.height + 30 * dpr);
    ctx.clip();
    const X = (v, share) => (share ? bbox.left + v * bbox.width : u.valToPos(v, "x", true));
    const Y = (v, share) => (share ? bbox.top + (1 - v) * bbox.height : u.valToPos(v, "y", true));
    for (const m of this.panel.marks) {
      if (m.mark !== kind || (m.entry != null && !this.figure.shows(m.entry))) continue;
      if (kind === "rectangle") {
        const x0 = X(m.x[0], m.x_share), x1 = X(m.x[1], m.x_share), y0 = Y(m.y[0], m.y_share), y1 = Y(m.y[1], m.y_share);
        if (m.hatched) this.hatch(ctx, bbox, m.look);
        else if (m.look.filled) { ctx.fillStyle = faded(m.look.colour, m.look.alpha); ctx.fillRect(x0, Math.min(y0, y1), x1 - x0, Math.abs(y1 - y0)); }
      } else if (kind === "segments") {
        ctx.strokeStyle = faded(m.look.colour, m.look.alpha); ctx.lineWidth = m.look.width * dpr;
        ctx.setLineDash(m.look.dash.map((d) => d * dpr)); ctx.beginPath();
        for (const [a, b, c, d] of m.lines) { ctx.moveTo(X(a, m.x_share), Y(b, m.y_share)); ctx.lineTo(X(c, m.x_share), Y(d, m.y_share)); }
        ctx.stroke(); ctx.setLineDash([]);
      } else {
        ctx.save();
        ctx.fillStyle = colour(m.colour); ctx.font = `${m.bold ? "bold " : ""}${m.size * dpr}px system-ui, sans-serif`;
        ctx.textAlign = m.rotation === 90 ? "left" : m.horizontal; ctx.textBaseline = { top: "top", center: "middle" }[m.vertical] ?? "bottom";
        ctx.translate(X(m.x, m.x_share) + m.dx * dpr, Y(m.y, m.y_share) - m.dy * dpr);
        if (m.rotation) { ctx.rotate((-m.rotation * Math.PI) / 180); ctx.textBaseline = "middle"; }
        ctx.fillText(m.text, 0, 0); ctx.restore();
      }
    }
    ctx.restore();
  }
  hatch(ctx, { left, top, width, height }, look) {
    ctx.strokeStyle = colour(look.colour); ctx.lineWidth = devicePixelRatio; ctx.beginPath();
    const step = 9 * devicePixelRatio;
    for (let d = -height; d < width; d += step) { ctx.moveTo(left + d, top + height); ctx.lineTo(left + d + height, top); }
    ctx.save(); const clip = new Path2D(); clip.rect(left, top, width, height); ctx.clip(clip); ctx.stroke(); ctx.restore();
  }
  markers() {
    const { u } = this, { ctx, bbox } = u, dpr = devicePixelRatio;
    ctx.save(); ctx.beginPath(); ctx.rect(bbox.left - 4 * dpr, bbox.top - 4 * dpr, bbox.width + 8 * dpr, bbox.height + 8 * dpr); ctx.clip();
    for (const s of this.panel.series) {
      if (!s.look.marker || !this.figure.shows(s.entry)) continue;
      const { level, a, b } = this.views.get(s);
      if (b - a > MARKERS_MOST) continue;
      ctx.strokeStyle = colour(s.look.colour); ctx.fillStyle = colour(s.look.filled ? s.look.colour : "paper"); ctx.lineWidth = 1.3 * dpr;
      for (let i = a; i < b; i++)
        if (!Number.isNaN(level.low[i])) {
          ctx.beginPath();
          shape(ctx, s.look.marker, u.valToPos(level.x[i], "x", true), u.valToPos(level.low[i], "y", true), (s.look.size * dpr) / 2);
          if (!"+x".includes(s.look.marker)) ctx.fill();
          ctx.stroke();
        }
    }
    ctx.restore();
  }
}
