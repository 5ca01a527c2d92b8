// What the theme leaves open. Runs in the head, before anything is drawn.
(() => {
  // Light or dark: what the reader chose before, else what the system asks for; at once, so that no page flashes.
  const root = document.documentElement;
  const chosen = root.dataset.mode === "light" || root.dataset.mode === "dark";
  const system = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  root.dataset.mode = chosen ? root.dataset.mode : "auto";
  root.dataset.theme = chosen ? root.dataset.mode : system;

  // From the file system no script may read another page, so the search lists titles without excerpts.
  if (location.protocol === "file:") DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = false;

  // The arrows that open a part of the contents get a name for those who hear the page.
  document.addEventListener("DOMContentLoaded", () => {
    for (const arrow of document.querySelectorAll(".bd-sidebar-primary summary")) {
      const part = arrow.closest("li").querySelector("a");
      arrow.setAttribute("aria-label", `Pages of: ${part ? part.textContent.trim() : "this part"}`);
    }
  });
})();
