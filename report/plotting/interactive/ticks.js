// Ticks of linear and logarithmic axes.

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
