// Shapes of markers, and the samples of lines, markers and areas in legends.

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
