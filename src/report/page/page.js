// Sorts a table by the column whose heading is clicked; again, the other way round. Cells carry their
// value in data-value; a cell without one stays last either way.
for (const table of document.querySelectorAll("table.sortable")) {
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((heading, column) => heading.querySelector("button").addEventListener("click", () => {
    const first = heading.dataset.first;
    const other = first === "ascending" ? "descending" : "ascending";
    const order = heading.getAttribute("aria-sort") === first ? other : first;
    headings.forEach((h) => h.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", order);
    const sign = order === "ascending" ? 1 : -1;
    const value = (row) => row.cells[column].dataset.value;
    const compare = (a, b) => {
      if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
      return sign * (heading.dataset.kind === "number" ? a - b : a.localeCompare(b, "en", { numeric: true }));
    };
    const body = table.tBodies[0];
    body.append(...[...body.rows].sort((a, b) => compare(value(a), value(b))));
  }));
}
// Shows the chosen frame of a sequence as two methods show it.
for (const stepper of document.querySelectorAll(".stepper")) {
  const [slider, output] = [stepper.querySelector("input"), stepper.querySelector("output")];
  const show = () => {
    for (const pane of stepper.querySelectorAll(".panes > div")) {
      const method = pane.querySelector("select").value;
      const of = [...stepper.querySelectorAll("img[hidden]")];
      const frame = of.find((img) => img.dataset.method === method && img.dataset.frame === slider.value);
      pane.querySelector(".pane").src = frame.src;
      output.textContent = frame.dataset.name;
    }
  };
  stepper.addEventListener("input", show);
  show();
}
