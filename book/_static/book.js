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

  // Buttons above the table of claims show the claims of one outcome.
  document.addEventListener("DOMContentLoaded", () => {
    const table = document.querySelector("table.claims");
    if (!table) return;
    const rows = [...table.tBodies[0].rows];
    const outcomeOf = (row) => row.querySelector(".sd-badge").textContent;
    const outcomes = [...document.querySelectorAll("dt .sd-badge")].map((badge) => badge.textContent);
    const bar = document.createElement("div");
    bar.className = "claims-filter";
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Show the claims of one outcome");
    for (const outcome of ["all", ...outcomes]) {
      const isShown = (row) => outcome === "all" || outcomeOf(row) === outcome;
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = `${outcome} (${rows.filter(isShown).length})`;
      button.setAttribute("aria-pressed", String(outcome === "all"));
      button.addEventListener("click", () => {
        for (const other of bar.children) other.setAttribute("aria-pressed", String(other === button));
        for (const row of rows) row.hidden = !isShown(row);
      });
      bar.append(button);
    }
    (table.closest(".pst-scrollable-table-container") || table).before(bar);
  });
})();
