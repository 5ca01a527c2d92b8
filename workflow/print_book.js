// Prepare a page of the book for the PDF of all `pages`, given by their addresses.
async (pages) => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const address = (link) => link.href.split("#")[0];
  const name = (page, id) => `p${pages.indexOf(page)}-${id}`;
  const here = location.href.split("#")[0];
  if (window.MathJax && window.MathJax.startup) await window.MathJax.startup.promise;
  all("img").forEach((image) => { image.loading = "eager"; });
  await Promise.all(all("img").map((image) => image.decode().catch(() => null)));
  await document.fonts.ready;

  // Shrink what is wider than the paper.
  for (const wide of all("article table, article mjx-container")) {
    const room = wide.parentElement.clientWidth;
    if (room && wide.scrollWidth > room) wide.style.zoom = room / wide.scrollWidth;
  }

  // Every anchor gets a name that no other page has, and a link, without which the browser does not store its place.
  // Links to other pages lead to these names; those to files that are not in the PDF are removed.
  all("article a[href^='#']").forEach((link) => { link.href = `#${name(here, link.hash.slice(1))}`; });
  for (const link of all("article a[href]").filter((link) => link.protocol === "file:" && address(link) !== here)) {
    if (pages.includes(address(link))) link.hash = name(address(link), link.hash.slice(1));
    else link.removeAttribute("href");
  }
  document.querySelector("article").id = "";
  for (const anchor of all("article, article [id]")) {
    anchor.id = name(here, anchor.id);
    document.body.append(Object.assign(document.createElement("a"), { href: `#${anchor.id}` }));
  }
}
