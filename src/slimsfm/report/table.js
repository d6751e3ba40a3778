"use strict";
// A click on a header sorts its table: numbers in descending order, text alphabetically; a second click reverses it.
// A filter above a table shows the rows that contain all its words.
for (const table of document.querySelectorAll("table")) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
  heads.forEach((head, column) => head.addEventListener("click", () => {
    const numeric = head.classList.contains("number");
    const first = numeric ? "descending" : "ascending", second = numeric ? "ascending" : "descending";
    const order = head.getAttribute("aria-sort") === first ? second : first;
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", order);
    const sign = order === "ascending" ? 1 : -1;
    body.append(...[...body.rows].sort((a, b) => sign * compare(a.cells[column], b.cells[column], numeric, sign)));
  }));
  const filter = table.parentElement.parentElement.querySelector(".filter");
  filter?.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/);
    for (const row of body.rows) {
      const names = [...row.cells].filter(cell => !cell.classList.contains("number"));
      const text = names.map(cell => cell.textContent.toLowerCase()).join(" ");
      row.hidden = !words.every(word => text.includes(word));
    }
  });
}

function compare(a, b, numeric, sign) {
  if (!numeric) return a.textContent.localeCompare(b.textContent);
  const missing = sign * Infinity; // a dash comes last in both orders
  const x = "value" in a.dataset ? Number(a.dataset.value) : missing;
  const y = "value" in b.dataset ? Number(b.dataset.value) : missing;
  return x === y ? 0 : x < y ? -1 : 1;
}
