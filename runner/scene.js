// viser gives its sliders, number fields, bars, icons and pictures no names. They get those of their labels here.
(() => {
  if (window.viserNamed) return;
  window.viserNamed = true;
  const icons = { adjustments: "settings", "player-play-filled": "play", "player-pause-filled": "pause",
    "binary-tree-2": "scene tree" };
  const ours = new WeakSet();
  const label = (node) => {
    const outer = node.parentElement;
    return outer === null ? "" : outer.querySelector("label")?.textContent.trim() || label(outer);
  };
  // The player of a recorded scene has a slider, its time and its speed, all without labels.
  const field = (node) => label(node) || (node.value?.endsWith("x") ? "speed" : "time [s]");
  const icon = (node) => {
    if (/CloseButton/.test(node.className)) return "close";
    const drawn = /tabler-icon-([\w-]+)/.exec(node.querySelector("svg")?.getAttribute("class") ?? "")?.[1] ?? "";
    return icons[drawn] ?? drawn.replaceAll("-", " ");
  };
  const title = (node) => node.closest(".uplot")?.querySelector(".u-title")?.textContent || "3D view of the arm";
  const name = (selector, found) => {
    for (const node of document.querySelectorAll(selector)) {
      const named = node.getAttribute("aria-label") || node.labels?.length || node.textContent.trim();
      const text = named && !ours.has(node) ? "" : found(node);
      if (!text) continue;
      ours.add(node);
      node.setAttribute("aria-label", text);
    }
  };
  const all = () => {
    name("[role=slider], input", field);
    name("[role=progressbar]", () => "progress");
    name("button", icon);
    name("canvas", title);
    for (const node of document.querySelectorAll("canvas:not([role])")) node.setAttribute("role", "img");
    for (const node of document.querySelectorAll("img:not([alt])")) node.setAttribute("alt", "");
    for (const node of document.querySelectorAll(".mantine-ScrollArea-viewport:not([tabindex])")) node.tabIndex = 0;
  };
  let waiting = false;
  new MutationObserver(() => {
    if (waiting) return;
    waiting = true;
    setTimeout(() => { waiting = false; all(); }, 100);
  }).observe(document.documentElement, { childList: true, subtree: true });
  all();
})();
