// Wide tables scroll sideways: the keyboard must reach them.
const reach = () => {
  for (const box of document.querySelectorAll(".md-typeset__scrollwrap, .md-typeset pre > code")) {
    if (box.scrollWidth > box.clientWidth + 1) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
};
window.addEventListener("load", () => { reach(); setTimeout(reach, 500); });
window.addEventListener("resize", reach);
document.querySelector(".md-search")?.setAttribute("aria-label", "Search");
