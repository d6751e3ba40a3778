"use strict";
// Pointing at a node of a reference graph, tapping it or moving there with arrow keys highlights its edges and its
// camera in the 3D view, and describes it.

for (const graph of document.querySelectorAll(".graph")) {
  const drawing = graph.querySelector("svg"), nodes = [...graph.querySelectorAll(".node")];
  const details = graph.querySelector(".details"), photo = details.querySelector("img");
  const text = details.querySelector("p");
  const edges = [...graph.querySelectorAll(".edges path")], legend = text.innerHTML;
  const centers = nodes.map(node => {
    const frame = node.querySelector("rect"), value = name => Number(frame.getAttribute(name));
    return { x: value("x") + value("width") / 2, y: value("y") + value("height") / 2, reach: value("width") };
  });
  let shown = null, pinned = null;

  function show(index) {
    if (index === shown) return;
    shown = index;
    const near = new Set([index]);
    for (const edge of edges) {
      const from = Number(edge.dataset.from), to = Number(edge.dataset.to), lit = from === index || to === index;
      edge.classList.toggle("lit", lit);
      if (lit) near.add(from).add(to);
    }
    drawing.classList.toggle("pointed", index !== null);
    nodes.forEach((node, k) => node.classList.toggle("lit", near.has(k)));
    describe(index);
    graph.parentElement.dispatchEvent(new CustomEvent("image", { detail: index }));
  }

  function describe(index) {
    const source = index === null ? null : nodes[index].querySelector("image");
    photo.hidden = !source;
    if (source) photo.src = source.getAttribute("href");
    if (index === null) { text.innerHTML = legend; return; }
    const name = nodes[index].dataset.name, title = document.createElement("b");
    title.textContent = name;
    text.replaceChildren(title, nodes[index].getAttribute("aria-label").slice(name.length));
  }

  // The node under a pointer, or close enough to a finger.
  function under(event) {
    const hit = nodes.indexOf(event.target.closest(".node"));
    if (hit >= 0) return hit;
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(drawing.getScreenCTM().inverse());
    const gaps = centers.map(({ x, y }) => Math.hypot(x - at.x, y - at.y));
    const best = gaps.indexOf(Math.min(...gaps));
    return gaps[best] < centers[best].reach ? best : null;
  }

  // The nearest node in the direction of an arrow key.
  function neighbor(index, dx, dy) {
    const { x, y } = centers[index];
    const costs = centers.map((other, k) => {
      const along = (other.x - x) * dx + (other.y - y) * dy, across = Math.abs((other.x - x) * dy + (other.y - y) * dx);
      return k === index || along <= across / 2 ? Infinity : along + 2 * across;
    });
    const best = costs.indexOf(Math.min(...costs));
    return costs[best] < Infinity ? best : index;
  }

  function focus(index) {
    nodes.forEach((node, k) => node.setAttribute("tabindex", k === index ? "0" : "-1"));
    nodes[index].focus();
  }

  drawing.addEventListener("pointermove", event => { if (event.pointerType === "mouse") show(under(event) ?? pinned); });
  drawing.addEventListener("pointerleave", event => { if (event.pointerType === "mouse") show(pinned); });
  drawing.addEventListener("click", event => {
    const index = under(event);
    pinned = index === pinned ? null : index;
    show(pinned);
  });
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  nodes.forEach((node, index) => {
    node.addEventListener("focus", () => show(index));
    node.addEventListener("blur", () => show(pinned));
    node.addEventListener("keydown", event => {
      if (!(event.key in ways)) return;
      event.preventDefault();
      focus(neighbor(index, ...ways[event.key]));
    });
  });
}
