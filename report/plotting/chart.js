// Interactive charts over the page's static figures. Input: <script class="chart-data"> in a
// <figure>, encoded by chart_encoding.py. Needs uPlot. Without JavaScript the SVG remains.
"use strict";
(() => {
  const NARROW_PX = 700, FONT = "11px system-ui, sans-serif", Y_AXIS_PX = 54, Y_LABEL_PX = 16, PER_LEVEL = 2;
  const POINTS_PER_PX = 2, ALL_POINTS = 3000, WHEEL = 0.0025, ZOOM_KEY = 1.5, MARKERS_MOST = 4000;

  // ---- colours, numbers -------------------------------------------------------------------
  let palette = {};
  const colour = (role) => {
    if (role.startsWith("#")) return role;
    palette[role] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${role}`).trim();
    return palette[role] || "#888888";
  };
  const faded = (role, alpha) =>
    colour(role) + Math.round(255 * alpha).toString(16).padStart(2, "0");

  const SUPERSCRIPT = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  const power = (exponent) =>
    "10" + (exponent < 0 ? "⁻" : "") + [...String(Math.abs(exponent))].map((d) => SUPERSCRIPT[d]).join("");
  const minus = (text) => text.replace("-", "−");

  /** Return a value with the digits that the step of the stored values supports. */
  const number = (value, step) => {
    if (!Number.isFinite(value)) return "—";
    const size = Math.abs(value);
    const digits = Math.max(1, Math.min(6, step > 0 && size > 0 ? Math.ceil(Math.log10(size / step)) : 6));
    if (size !== 0 && (size < 1e-3 || size >= 1e6)) {
      const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
      return `${minus(mantissa)}·${power(Number(exponent))}`;
    }
    const decimals = step > 0 ? Math.max(0, Math.min(8, Math.ceil(-Math.log10(step)))) : 6;
    const text = value.toFixed(decimals);
    return minus(step > 0 ? text : String(Number(text)));
  };

  // ---- data -------------------------------------------------------------------------------
  const inflate = async (base64) => {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };

  /** Decode a chart: each series gets x, low, high, and `levels` of ever longer bins when needed. */
  const decode = (bytes) => {
    const view = new DataView(bytes.buffer);
    const length = view.getUint32(0, true);
    const chart = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
    let at = 4 + length;
    const arrays = [];
    const abscissa = (x, n) => {
      if (Array.isArray(x)) return Float64Array.from({ length: n }, (_, i) => x[0] + i * x[1]);
      if (x === arrays.length) {
        arrays.push(Float64Array.from({ length: n }, (_, i) => view.getFloat64(at + 8 * i, true)));
        at += 8 * n;
      }
      return arrays[x];
    };
    const values = (run, log) => {
      const out = new Float64Array(run.n);
      let q = 0;
      for (let i = 0; i < run.n; i++) {
        q = (q + (bytes[at + i] << 8) + bytes[at + run.n + i]) & 0xffff;
        const y = run.low + q * run.step;
        out[i] = q === 0xffff ? NaN : log ? 10 ** y : y;
      }
      at += 2 * run.n;
      return out;
    };
    for (const panel of chart.panels)
      for (const series of panel.series) {
        const parts = series.runs.map((run) => {
          const x = abscissa(run.x, run.n);
          const low = values(run, panel.y.log);
          return { x, low, high: run.two ? values(run, panel.y.log) : low, run };
        });
        Object.assign(series, joined(parts));
        series.step = Math.max(0, ...series.runs.map((run) => run.step));
        series.least = Math.min(...series.starts.map(([, count]) => count));
        series.levels = [];
      }
    return chart;
  };

  /** Join runs that follow one another, with a gap where time is missing between two. */
  const joined = (parts) => {
    if (parts.length === 1)
      return { ...parts[0], starts: [[0, parts[0].run.count, stepOf(parts[0].x)]] };
    const x = [], low = [], high = [], starts = [];
    for (const part of parts) {
      const last = x.length - 1, step = Math.max(stepOf(part.x), starts.length ? starts.at(-1)[2] : 0);
      if (last >= 0 && part.x[0] - x[last] > 3 * step) { x.push(x[last]); low.push(NaN); high.push(NaN); }
      starts.push([x.length, part.run.count, stepOf(part.x)]);
      for (let i = 0; i < part.x.length; i++) { x.push(part.x[i]); low.push(part.low[i]); high.push(part.high[i]); }
    }
    return { x: Float64Array.from(x), low: Float64Array.from(low), high: Float64Array.from(high), starts };
  };
  const stepOf = (x) => (x.length > 1 ? (x[x.length - 1] - x[0]) / (x.length - 1) : 0);

  /** Return the first index with x[i] >= value. */
  const search = (x, value) => {
    let a = 0, b = x.length;
    while (a < b) { const m = (a + b) >> 1; if (x[m] < value) a = m + 1; else b = m; }
    return a;
  };

  /** Return the level whose bins hold at least `samples` samples: shorter bins are joined. */
  const level = (series, samples) => {
    if (samples <= series.least) return { x: series.x, low: series.low, high: series.high, samples };
    const x = [], low = [], high = [];
    series.starts.forEach(([first, count], k) => {
      const end = series.starts[k + 1]?.[0] ?? series.x.length, factor = Math.max(1, samples / count);
      for (let i = first; i < end; i += factor) {
        const b = Math.min(i + factor, end);
        let least = NaN, most = NaN;
        for (let j = i; j < b; j++) {
          if (Number.isNaN(series.low[j])) continue;
          if (!(series.low[j] >= least)) least = series.low[j];
          if (!(series.high[j] <= most)) most = series.high[j];
        }
        x.push(series.x[i]); low.push(least); high.push(most);
        // A missing value at a run's end is a gap, which remains.
        if (factor > 1 && b === end && Number.isNaN(series.low[end - 1]) && !Number.isNaN(least)) { x.push(series.x[end - 1]); low.push(NaN); high.push(NaN); }
      }
    });
    return { x: Float64Array.from(x), low: Float64Array.from(low), high: Float64Array.from(high), samples };
  };

  /** Return the finest level with few enough points between two abscissae, and their rows. */
  const visible = (series, from, to, px) => {
    const most = Math.max(POINTS_PER_PX * px, series.x.length <= ALL_POINTS ? ALL_POINTS : 0);
    for (let k = 0; ; k++) {
      const found = (series.levels[k] ??= level(series, series.least * PER_LEVEL ** k));
      const a = Math.max(search(found.x, from) - 1, 0);
      const b = Math.min(search(found.x, to) + 1, found.x.length);
      if (b - a <= most || series.kind !== "line" || k > 28) return { level: found, a, b };
    }
  };

  // ---- axes -------------------------------------------------------------------------------
  const axisLimits = (axis) => ({ min: axis.low, max: axis.high });
  const toScale = (axis, v) => (axis.log ? Math.log10(v) : v);
  const fromScale = (axis, v) => (axis.log ? 10 ** v : v);

  const linearTicks = (min, max, most) => {
    const rough = (max - min) / Math.max(most, 1), unit = 10 ** Math.floor(Math.log10(rough));
    const factor = [1, 2, 2.5, 5, 10].find((m) => m * unit >= rough * 0.999), step = unit * factor;
    const out = [];
    for (let k = Math.ceil(min / step - 1e-9); k * step <= max + 1e-9 * step; k++) out.push(k * step);
    return { at: out, decimals: Math.max(0, -Math.floor(Math.log10(step) + 1e-9) + (factor === 2.5 ? 1 : 0)) };
  };
  const logTicks = (min, max, most) => {
    const decades = Math.log10(max / min);
    const out = [];
    if (decades < 0.7) return linearTicks(min, max, most);
    const factors = decades <= most / 3 ? [1, 2, 5] : [1];
    const every = Math.max(1, Math.ceil(decades / most));
    for (let e = Math.floor(Math.log10(min)); e <= Math.ceil(Math.log10(max)); e++)
      if (e % every === 0)
        for (const f of factors) { const v = f * 10 ** e; if (v >= min * 0.999 && v <= max * 1.001) out.push(v); }
    return { at: out, decimals: null };
  };
  const ticks = (axis, min, max, most) => {
    const fixed = axis.ticks.filter(([v]) => v >= min && v <= max);
    const named = axis.ticks.some(([, text]) => /[a-z]{2}/i.test(text));
    if (fixed.length >= 2 || named)
      return { at: fixed.map(([v]) => v), text: new Map(fixed) };
    return axis.log ? logTicks(min, max, most) : linearTicks(min, max, most);
  };
  const tickText = (found, isX, v) => {
    if (found.text) return found.text.get(v) ?? "";
    const size = Math.abs(v);
    if (found.decimals !== null && size < 1e5 && (size === 0 || found.decimals <= 4)) return minus(v.toFixed(found.decimals));
    const exponent = Math.floor(Math.log10(size) + 1e-9), mantissa = v / 10 ** exponent;
    if (isX && size >= 1e-3 && size < 1e5) return minus(String(Number(v.toPrecision(4))));
    const short = Number(mantissa.toPrecision(3));
    return short === 1 ? power(exponent) : `${minus(String(short))}·${power(exponent)}`;
  };

  // ---- axes in common ---------------------------------------------------------------------
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

  // ---- one panel --------------------------------------------------------------------------
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
          draw: [() => { this.markers(); this.marks("note"); }],
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
      const whole = all.length > 1 ? uPlot.join(all) : all[0];
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
      const place = decimals === null ? String(Number(where.toPrecision(4))) : where.toFixed(decimals);
      element("div", "at", this.box, `${minus(place)} ${panel.x.unit}`);
      for (const { entry, look, label, text } of lines) {
        const line = element("div", "", this.box);
        line.append(swatch(look, entry?.area));
        const name = label || "";
        if (name && own) element("span", "name", line, name);
        element("span", "value", line, text);
      }
      this.box.hidden = lines.length === 0;
      const left = this.u.valToPos(x, "x"), whole = this.u.over.clientWidth, wide = this.box.offsetWidth;
      const beside = left > whole / 2 ? left - 10 - wide : left + 10;
      this.box.style.left = `${Math.max(0, Math.min(beside, whole - wide))}px`;
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
      for (const line of out) {
        const band = line.id === null ? undefined : bands.get(line.id);
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

  const shape = (ctx, marker, x, y, r) => {
    const polygon = (...points) => { points.forEach(([a, b], k) => (k ? ctx.lineTo(x + a * r, y + b * r) : ctx.moveTo(x + a * r, y + b * r))); ctx.closePath(); };
    if (marker === "s") polygon([-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]);
    else if (marker === "D") polygon([0, -1.2], [1.2, 0], [0, 1.2], [-1.2, 0]);
    else if (marker === "^") polygon([0, -1.1], [1.1, 0.9], [-1.1, 0.9]);
    else if (marker === "v") polygon([0, 1.1], [1.1, -0.9], [-1.1, -0.9]);
    else if (marker === "+" || marker === "P") { ctx.moveTo(x - r, y); ctx.lineTo(x + r, y); ctx.moveTo(x, y - r); ctx.lineTo(x, y + r); }
    else if (marker === "x" || marker === "X") { ctx.moveTo(x - r, y - r); ctx.lineTo(x + r, y + r); ctx.moveTo(x - r, y + r); ctx.lineTo(x + r, y - r); }
    else ctx.arc(x, y, marker === "." ? r / 2 : r, 0, 2 * Math.PI);
  };

  /** Return a legend's sample of a line, marker or area. */
  const swatch = (look, area) => {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("class", "swatch"); svg.setAttribute("viewBox", "0 0 26 12"); svg.setAttribute("aria-hidden", "true");
    const ink = look.colour.startsWith("#") || !look.colour ? look.colour || "none" : `var(--${look.colour})`;
    const add = (tag, attributes) => {
      const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
      for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
      svg.append(made);
    };
    if (area) add("rect", { x: 2, y: 1, width: 22, height: 10, fill: look.filled ? ink : "none", stroke: look.filled ? "none" : ink, "fill-opacity": look.alpha });
    else {
      if (look.width || !look.marker) add("line", { x1: 1, x2: 25, y1: 6, y2: 6, stroke: ink, "stroke-width": Math.max(look.width, 1), "stroke-dasharray": look.dash.join(" "), opacity: look.alpha });
      if (look.marker) {
        const path = [];
        const pen = { moveTo: (a, b) => path.push(`M${a} ${b}`), lineTo: (a, b) => path.push(`L${a} ${b}`), closePath: () => path.push("Z"), arc: (a, b, r) => path.push(`M${a - r} ${b}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`) };
        shape(pen, look.marker, 13, 6, Math.max(look.size / 2, 3));
        add("path", { d: path.join(""), stroke: ink, "stroke-width": 1.3, fill: look.filled ? ink : "var(--paper)" });
      }
    }
    return svg;
  };

  // ---- one figure -------------------------------------------------------------------------
  class FigureView {
    constructor(figure, chart) {
      this.figure = figure; this.chart = chart; this.off = new Set(); this.name = figure.id;
      this.root = element("div", "chart"); figure.prepend(this.root);
      const bar = element("div", "chart-bar", this.root);
      this.legendButtons(chart.legend, element("span", "legend", bar));
      const tools = element("span", "tools", bar);
      this.resolution = element("span", "resolution", tools);
      this.button = element("button", "reset", tools, "Reset zoom");
      this.button.type = "button"; this.button.hidden = true;
      this.button.addEventListener("click", () => { for (const panel of this.panels) panel.reset(); });
      this.grid = element("div", "panels", this.root);
      this.grid.style.setProperty("--columns", chart.columns);
      this.panels = chart.panels.map((panel) => new PanelView(this, panel));
      figure.classList.add("live");
      this.size = this.root.clientWidth;
      this.root.classList.toggle("narrow", this.narrow);
      for (const panel of this.panels) panel.start();
      for (const panel of this.panels) panel.update();
      new ResizeObserver(() => {
        const width = this.root.clientWidth;
        if (width === this.size || width === 0) return;
        this.size = width; this.root.classList.toggle("narrow", this.narrow);
        for (const panel of this.panels) panel.resize();
      }).observe(this.root);
    }
    get narrow() { return this.root.clientWidth < NARROW_PX; }
    shows(entry) { return entry === null || entry === undefined || !this.off.has(entry); }
    used(entry) { return this.chart.panels.some((p) => p.series.some((s) => s.entry === entry) || p.marks.some((m) => m.entry === entry)); }

    legendButtons(entries, parent) {
      for (const k of entries) {
        const { label, look, area } = this.chart.entries[k];
        const item = element(this.used(k) ? "button" : "span", "entry", parent);
        item.append(swatch(look, area), label);
        if (!this.used(k)) continue;
        item.type = "button"; item.setAttribute("aria-pressed", "true"); item.title = "hide or show";
        item.addEventListener("click", () => {
          if (!this.off.delete(k)) this.off.add(k);
          item.setAttribute("aria-pressed", String(this.shows(k)));
          for (const panel of this.panels) panel.update();
        });
      }
    }

    /** Show which resolution is drawn, and the button that resets the zoom. */
    status() {
      this.button.hidden = !this.panels.some((panel) => panel.zoomed);
      let longest = null;
      for (const panel of this.panels)
        for (const s of panel.panel.series) {
          if (s.kind !== "line" || !panel.views || (s.x.length <= ALL_POINTS && s.low === s.high)) continue;
          const found = panel.samplesAt(s, (panel.group.min + panel.group.max) / 2);
          if (!longest || found.samples > longest.samples) longest = { ...found, unit: panel.panel.x.unit };
        }
      if (!longest) { this.resolution.textContent = ""; return; }
      const ms = longest.unit === "s" && longest.time < 1;
      const time = `${Number((ms ? 1e3 * longest.time : longest.time).toPrecision(3))} ${ms ? "ms" : longest.unit}`;
      this.resolution.textContent = longest.samples > 1
        ? `minimum and maximum of ${longest.samples} samples${longest.time > 0 ? ` (${time})` : ""}${longest.samples === longest.stored ? ", the finest of this page" : ""}`
        : "every sample";
    }
  }

  // ---- the page ---------------------------------------------------------------------------
  const views = [];
  const start = async (figure) => {
    const data = figure.querySelector("script.chart-data");
    const chart = decode(await inflate(data.textContent));
    data.remove();
    views.push(new FigureView(figure, chart));
  };
  const begin = () => {
    if (!("DecompressionStream" in window) || !window.uPlot) return;
    const figures = [...document.querySelectorAll("figure")].filter((f) => f.querySelector("script.chart-data"));
    if (!figures.length) return;
    const hint = element("p", "note chart-hint", null, "Figures are interactive: drag to zoom, Ctrl + wheel or pinch to zoom, Shift + drag to pan, double-click or Escape to reset. Click a legend entry to hide it.");
    figures[0].before(hint);
    const observer = new IntersectionObserver((changes) => {
      for (const change of changes)
        if (change.isIntersecting) { observer.unobserve(change.target); start(change.target); }
    }, { rootMargin: "600px 0px" });
    figures.forEach((figure) => observer.observe(figure));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      palette = {};
      for (const view of views) for (const panel of view.panels) panel.redraw();
    });
  };
  begin();
})();
