// Colours of the page and texts of numbers.

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
