// Charts over the static figures. Input: <script class="chart-data"> in a <figure>; without JavaScript, or
// without DecompressionStream, the SVG remains.

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
