"use strict";
// Charts are drawn when they come near the screen, and all that are not folded away before printing.
(() => {
  const settings = { responsive: true, displaylogo: false, displayModeBar: "hover",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg" } };
  const charts = [...document.querySelectorAll(".chart")];
  const draw = (chart) => {
    if (chart.dataset.drawn || chart.offsetParent === null) return;
    chart.dataset.drawn = "yes";
    const { data, layout } = JSON.parse(chart.nextElementSibling.textContent);
    Plotly.newPlot(chart, data, layout, settings);
  };
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) draw(entry.target);
  }, { rootMargin: "400px" });
  charts.forEach((chart) => watch.observe(chart));
  const idle = window.requestIdleCallback || ((work) => setTimeout(work, 50));
  const next = () => {
    const chart = charts.find((one) => !one.dataset.drawn && one.offsetParent !== null);
    if (!chart) { document.documentElement.dataset.ready = "yes"; return; }
    draw(chart);
    idle(next);
  };
  idle(next);
  for (const part of document.querySelectorAll("details")) part.addEventListener("toggle", () => idle(next));
  const fit = (width) => {
    for (const chart of charts) {
      if (!chart.dataset.drawn || chart.offsetParent === null) continue;
      const square = chart.classList.contains("square");
      Plotly.relayout(chart, width === null ? { autosize: true, width: null }
        : { autosize: false, width: square ? 640 : width, height: square ? 640 : chart.clientHeight });
    }
  };
  window.addEventListener("beforeprint", () => { charts.forEach(draw); fit(340); });
  window.addEventListener("afterprint", () => fit(null));
})();
