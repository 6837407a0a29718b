// Where the box with the values at the cursor stands: where it covers no curve.

const COLUMN_PX = 4, BESIDE_PX = 10, FREE_PX = 2;

/** Return for each column of pixels of a panel the [top, bottom] of each curve in it. */
function curvesInPixels(view) {
  const { u } = view, columns = Array.from({ length: Math.ceil(u.over.clientWidth / COLUMN_PX) + 1 }, () => []);
  const add = (column, a, b) => columns[column]?.push([Math.min(a, b), Math.max(a, b)]);
  for (const s of view.panel.series) {
    if (!view.figure.shows(s.entry)) continue;
    const { level, a, b } = view.views.get(s), floor = s.kind === "steps" ? u.over.clientHeight : null;
    const dots = s.kind === "line" && s.look.width === 0, half = dots ? s.look.size / 2 : s.look.width / 2;
    let before = null;
    for (let i = Math.max(a - 1, 0); i < Math.min(b + 1, level.x.length); i += 1) {
      if (Number.isNaN(level.low[i])) { before = null; continue; }
      const here = { x: u.valToPos(level.x[i], "x"), top: u.valToPos(level.high[i], "y") - half, bottom: floor ?? u.valToPos(level.low[i], "y") + half };
      const first = before && !dots ? before : here, span = here.x - first.x;
      const from = Math.max(0, Math.floor(first.x / COLUMN_PX)), to = Math.min(columns.length - 1, Math.floor(here.x / COLUMN_PX));
      for (let column = from; column <= to; column += 1) {
        const shares = [column, column + 1].map((edge) => (span > 0 ? Math.max(0, Math.min(1, (edge * COLUMN_PX - first.x) / span)) : 1));
        const tops = shares.map((share) => first.top + share * (here.top - first.top));
        const bottoms = shares.map((share) => first.bottom + share * (here.bottom - first.bottom));
        add(column, Math.min(...tops), Math.max(...bottoms));
      }
      before = here;
    }
  }
  return columns;
}

/** Return the place of a box of `wide` x `tall` pixels beside the cursor at `left`, null if there is none. */
function freePlace(view, left, wide, tall) {
  const { u } = view, whole = u.over.clientWidth, high = u.over.clientHeight;
  view.curves ??= curvesInPixels(view);
  const covers = (x, y) => {
    const from = Math.floor(x / COLUMN_PX), to = Math.floor((x + wide) / COLUMN_PX);
    for (let column = from; column <= to; column += 1)
      for (const [top, bottom] of view.curves[column] ?? [])
        if (bottom > y - FREE_PX && top < y + tall + FREE_PX) return true;
    return false;
  };
  const right = left + BESIDE_PX, before = left - BESIDE_PX - wide;
  const lefts = left > whole / 2 ? [before, right] : [right, before];
  for (const y of [FREE_PX, high - tall - FREE_PX, (high - tall) / 2])
    for (const x of [...lefts, 0, whole - wide])
      if (x >= 0 && y >= 0 && x + wide <= whole && y + tall <= high && !covers(x, y)) return { x, y };
  return null;
}
