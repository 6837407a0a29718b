// Decode the data of chart_encoding.py and reduce them to the resolution of the screen.

const PER_LEVEL = 2, POINTS_PER_PX = 2, ALL_POINTS = 3000;

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
