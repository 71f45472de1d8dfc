"use strict";
// Opens the zipped charts and plotly, then draws: what is on the screen first, then all that is not folded away; the
// rest as soon as it is unfolded.
(() => {
  const settings = { responsive: true, displaylogo: false, displayModeBar: "hover",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg" } };
  const root = document.documentElement;
  const charts = [...document.querySelectorAll(".chart")];
  let descriptions = null;

  const opened = async (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (sign) => sign.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  // A column is {low, step, moves}: its moves from value to value, in steps above the lowest.
  const columns = (key, value) => {
    if (value === null || value.moves === undefined) return value;
    let place = 0;
    return Float64Array.from(value.moves, (move) => value.low + value.step * (place += move));
  };

  const draw = (chart) => {
    if (descriptions === null || chart.dataset.drawn || chart.offsetParent === null) return;
    chart.dataset.drawn = "yes";
    const { data, layout } = descriptions[charts.indexOf(chart)];
    Plotly.newPlot(chart, data, layout, settings);
  };
  // Nearest to the screen first; the order is found anew after scrolling.
  let queue = null;
  const away = (chart) => {
    const box = chart.getBoundingClientRect();
    return Math.max(0, box.top - window.innerHeight, -box.bottom);
  };
  const next = () => {
    const begun = performance.now();
    if (queue === null) {
      const left = charts.filter((one) => !one.dataset.drawn && one.closest("details:not([open])") === null);
      queue = left.map((one) => [away(one), one]).sort((one, other) => other[0] - one[0]).map((pair) => pair[1]);
    }
    const order = queue;
    while (order.length && performance.now() - begun < 40) draw(order.pop());
    if (order.length) setTimeout(next); else root.dataset.ready = "yes";
  };
  window.addEventListener("scroll", () => { if (!root.dataset.ready) queue = null; }, { passive: true });

  // A table wider than its place shows each row as a block of named values.
  const tables = [...document.querySelectorAll(".scroll > table")];
  for (const table of tables) {
    const names = [...table.querySelectorAll("thead th")].map((one) => one.textContent);
    for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, k) => { cell.dataset.name = names[k] || ""; });
  }
  const stack = () => {
    for (const table of tables) table.classList.remove("stacked");
    const wide = tables.filter((one) => one.parentElement.scrollWidth > one.parentElement.clientWidth + 1);
    for (const table of wide) table.classList.add("stacked");
  };
  stack();
  window.addEventListener("resize", stack);

  // On a narrow screen each long part is folded behind its heading; a link, a print or a wide screen opens it.
  const narrow = window.matchMedia("(max-width: 640px)");
  const foldable = () => {
    const long = [...document.querySelectorAll("main > section")].filter((one) => one.offsetHeight > window.innerHeight);
    for (const one of long) {
      if (one.querySelector(":scope > details.part")) continue;
      const part = document.createElement("details"), head = document.createElement("summary");
      part.className = "part";
      head.append(one.querySelector("h2"));
      part.append(head, ...one.childNodes);
      one.append(part);
      part.addEventListener("toggle", () => { stack(); part.querySelectorAll(".chart").forEach(draw); });
    }
  };
  const unfold = (inside) => { for (const part of inside.querySelectorAll("details.part")) part.open = true; };
  const target = () => {
    const one = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    if (!one) return;
    unfold(one);
    one.closest("details.part")?.setAttribute("open", "");
    one.scrollIntoView();
  };
  if (narrow.matches) foldable();
  narrow.addEventListener("change", () => { if (narrow.matches) foldable(); else unfold(document); });
  window.addEventListener("hashchange", target);
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[href^='#']");
    if (link && link.hash === location.hash) target();
  });
  target();

  for (const part of document.querySelectorAll("details:not(.part)")) {
    part.addEventListener("toggle", () => { stack(); part.querySelectorAll(".chart").forEach(draw); });
  }
  const fit = (width) => {
    for (const chart of charts) {
      if (!chart.dataset.drawn || chart.offsetParent === null) continue;
      const square = chart.classList.contains("square");
      Plotly.relayout(chart, width === null ? { autosize: true, width: null }
        : { autosize: false, width: square ? 640 : width, height: square ? 640 : chart.clientHeight });
    }
  };
  window.addEventListener("beforeprint", () => { unfold(document); charts.forEach(draw); fit(340); });
  window.addEventListener("afterprint", () => { fit(null); stack(); });

  const begin = async () => {
    if (!charts.length) { root.dataset.ready = "yes"; return; }
    const [data, library] = await Promise.all([opened("charts"), opened("plotly")]);
    const script = document.createElement("script");
    script.textContent = library;
    document.head.append(script);
    descriptions = JSON.parse(data, columns);
    next();
  };
  begin().catch((error) => {
    for (const chart of charts) chart.textContent = "No plot: this browser cannot open the data of the page (" + error + ").";
  });
})();
