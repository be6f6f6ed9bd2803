// Figures that carry their numbers (data-axes): values under the pointer, zoom by dragging, back by a double click.
// Keys: left and right go along a curve, up and down to another, + and - zoom, Escape goes back. Paper shows the picture.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg", NEAR = 60, LEAST = 8, TICKS = 5;
  const make = (parent, name, given = {}, text = "") => {
    const one = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(given)) one.setAttribute(key, value);
    one.textContent = text;
    parent.append(one);
    return one;
  };
  const shown = value => String(+value.toPrecision(6));

  // A scale between the numbers of an axis and the pixels of the picture.
  function scale([low, high], logarithmic, from, to) {
    const f = logarithmic ? Math.log10 : v => v, back = logarithmic ? v => 10 ** v : v => v;
    const a = f(low), b = f(high);
    return { at: v => from + (f(v) - a) / (b - a) * (to - from), value: p => back(a + (p - from) / (to - from) * (b - a)) };
  }

  function prepare(figure) {
    const image = figure.querySelector("img"), told = figure.querySelector("output");
    const W = image.naturalWidth, H = image.naturalHeight;
    const svg = make(figure.querySelector(".stage"), "svg", { viewBox: `0 0 ${W} ${H}`, class: "closer", "aria-hidden": "true" });
    const zoomed = make(svg, "g"), over = make(svg, "g");
    const axes = JSON.parse(figure.dataset.axes).map(one => {
      const [x0, y0, x1, y1] = one.box.map((part, i) => part * (i % 2 ? H : W)), full = { x0, y0, x1, y1 };
      const x = scale(one.x, one.log[0], x0, x1), y = scale(one.y, one.log[1], y1, y0);
      const series = one.series.map(s => ({ ...s, px: s.x.map(x.at), py: s.y.map(y.at) }));
      return { names: one.names, full, x, y, series, key: one.box.join() };
    });
    const views = {};  // what is shown of each box, in pixels of the picture; axes on one box share it
    const view = a => views[a.key] ?? a.full;
    const seen = (a, x, y) => {  // where a pixel of the picture is on the screen
      const v = view(a), f = a.full;
      return [f.x0 + (x - v.x0) / (v.x1 - v.x0) * (f.x1 - f.x0), f.y0 + (y - v.y0) / (v.y1 - v.y0) * (f.y1 - f.y0)];
    };
    const inside = (f, x, y) => x >= f.x0 && x <= f.x1 && y >= f.y0 && y <= f.y1;
    let cursor = null, from = null;

    function draw() {
      zoomed.replaceChildren();
      for (const [key, v] of Object.entries(views)) {
        const a = axes.find(one => one.key === key), f = a.full, w = f.x1 - f.x0, h = f.y1 - f.y0;
        const part = make(zoomed, "svg", { x: f.x0, y: f.y0, width: w, height: h, preserveAspectRatio: "none",
          viewBox: `${v.x0} ${v.y0} ${v.x1 - v.x0} ${v.y1 - v.y0}` });
        make(part, "rect", { x: v.x0, y: v.y0, width: v.x1 - v.x0, height: v.y1 - v.y0, fill: "#fff" });
        make(part, "image", { href: image.src, width: W, height: H });
        make(zoomed, "path", { d: `M${f.x0 - 72} ${f.y0 - 12}h70V${f.y1 + 2}h${w + 24}v40H${f.x0 - 72}Z`, class: "veil" });  // other ticks
        make(zoomed, "rect", { x: f.x0, y: f.y0, width: w, height: h, class: "edge" });
        for (let i = 0; i < TICKS; i++) {
          const s = (i + 0.5) / TICKS, px = f.x0 + s * w, py = f.y0 + s * h;
          make(zoomed, "text", { x: px, y: f.y1 - 6, "text-anchor": "middle" }, (+a.x.value(v.x0 + s * (v.x1 - v.x0)).toPrecision(4)).toString());
          make(zoomed, "text", { x: f.x0 + 6, y: py + 6 }, (+a.y.value(v.y0 + s * (v.y1 - v.y0)).toPrecision(4)).toString());
        }
      }
      over.replaceChildren();
      if (!cursor) { told.textContent = ""; return; }
      const { a, s, i } = cursor, f = a.full, [x, y] = seen(a, s.px[i], s.py[i]);
      told.textContent = `${s.name ? s.name + ": " : ""}${a.names[0] || "x"} = ${shown(s.x[i])}, ${a.names[1] || "y"} = ${shown(s.y[i])}`;
      if (!inside(f, x, y)) return;
      make(over, "path", { d: `M${x} ${f.y0}V${f.y1}M${f.x0} ${y}H${f.x1}`, class: "cross" });
      make(over, "circle", { cx: x, cy: y, r: 7, fill: s.colour, stroke: "#fff", "stroke-width": 2 });
    }
    function nearest(x, y) {
      let best = null, least = NEAR ** 2;
      for (const a of axes) if (inside(a.full, x, y)) for (const s of a.series) for (let i = 0; i < s.x.length; i++) {
        const [px, py] = seen(a, s.px[i], s.py[i]), far = (px - x) ** 2 + (py - y) ** 2;
        if (far < least && inside(a.full, px, py)) { least = far; best = { a, s, i }; }
      }
      return best;
    }
    function zoom(a, x0, y0, x1, y1) {  // to a rectangle of the screen
      const v = view(a), f = a.full, u = (p, f0, f1, v0, v1) => v0 + (p - f0) / (f1 - f0) * (v1 - v0);
      const next = { x0: u(x0, f.x0, f.x1, v.x0, v.x1), x1: u(x1, f.x0, f.x1, v.x0, v.x1),
        y0: u(y0, f.y0, f.y1, v.y0, v.y1), y1: u(y1, f.y0, f.y1, v.y0, v.y1) };
      if (next.x1 - next.x0 >= f.x1 - f.x0) delete views[a.key]; else views[a.key] = next;
      draw();
    }
    const at = event => {
      const r = svg.getBoundingClientRect();
      return [(event.clientX - r.left) / r.width * W, (event.clientY - r.top) / r.height * H];
    };
    const back = () => { for (const key of Object.keys(views)) delete views[key]; draw(); };
    svg.addEventListener("pointerdown", event => {
      const [x, y] = at(event), a = axes.find(one => inside(one.full, x, y));
      if (a && event.button === 0) { from = { a, x, y }; svg.setPointerCapture(event.pointerId); }
    });
    svg.addEventListener("pointermove", event => {
      const [x, y] = at(event);
      cursor = from ? null : nearest(x, y);
      draw();
      if (from) make(over, "rect", { class: "chosen", x: Math.min(x, from.x), y: Math.min(y, from.y), width: Math.abs(x - from.x), height: Math.abs(y - from.y) });
    });
    svg.addEventListener("pointerup", event => {
      const begun = from, [x, y] = at(event);
      from = null;
      if (!begun || Math.abs(x - begun.x) < LEAST || Math.abs(y - begun.y) < LEAST) { draw(); return; }
      const f = begun.a.full, kept = (p, low, high) => Math.min(Math.max(p, low), high);
      const xs = [x, begun.x].map(p => kept(p, f.x0, f.x1)).sort((a, b) => a - b), ys = [y, begun.y].map(p => kept(p, f.y0, f.y1)).sort((a, b) => a - b);
      zoom(begun.a, xs[0], ys[0], xs[1], ys[1]);
    });
    svg.addEventListener("pointerleave", () => { if (!from) { cursor = null; draw(); } });
    svg.addEventListener("dblclick", back);
    figure.addEventListener("keydown", event => {
      const all = axes.flatMap(a => a.series.map(s => ({ a, s, i: 0 }))), c = cursor ?? all[0];
      const moves = { ArrowLeft: -1, ArrowRight: 1 }, turns = { ArrowUp: -1, ArrowDown: 1 }, sizes = { "+": 0.5, "-": 2 };
      if (event.key === "Escape") { cursor = null; back(); }
      else if (event.key in moves) cursor = { ...c, i: cursor ? Math.min(Math.max(c.i + moves[event.key] * (event.shiftKey ? 10 : 1), 0), c.s.x.length - 1) : 0 };
      else if (event.key in turns) cursor = all[(all.findIndex(one => one.s === c.s) + turns[event.key] + all.length) % all.length];
      else if (event.key in sizes) {
        const f = c.a.full, [x, y] = seen(c.a, c.s.px[c.i], c.s.py[c.i]), k = sizes[event.key];
        zoom(c.a, x + (f.x0 - x) * k, y + (f.y0 - y) * k, x + (f.x1 - x) * k, y + (f.y1 - y) * k);
      } else return;
      event.preventDefault();
      draw();
    });
    figure.tabIndex = 0;
  }
  for (const figure of document.querySelectorAll("figure[data-axes]")) figure.querySelector("img").decode().then(() => prepare(figure));
})();
