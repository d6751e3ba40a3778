/** The words and controls around the picture. */
import { wordsFor } from "./states.js";

/** @param {string} id @returns {any} */
export function element(id) {
  return document.getElementById(id);
}

/** What the page shows. Text is always set as text, never as markup. */
export class Panel {
  constructor() {
    this.title = element("title");
    this.hint = element("hint");
    this.figures = element("figures");
    this.said = "";
  }

  /** @param {string} state Of the page, for the style sheet. @param {string} title @param {string} [hint] */
  say(state, title, hint = "") {
    document.body.dataset.state = state;
    this.title.textContent = title;
    if (this.hint.textContent !== hint) this.hint.textContent = hint;
    this.announce(`${state}|${hint}`, hint ? `${title}. ${hint}` : title);
  }

  /** Screen readers are told when the state changes, not with each frame. @param {string} key @param {string} text */
  announce(key, text) {
    if (key === this.said) return;
    this.said = key;
    element("announcement").textContent = text;
  }

  /** @param {import("./live.js").Report} report @param {string} wanted What is searched. */
  report(report, wanted) {
    const { title, hint } = wordsFor(report.state, { ...report, name: report.name || wanted });
    this.say(report.state, title, hint);
    if (report.ms) this.figure(`${Math.round(report.lag)} ms · ${report.rate} fps`, `server ${Math.round(report.ms?.total ?? 0)} ms`);
  }

  /** @param {string} text @param {string} [more] */
  figure(text, more = "") {
    this.figures.textContent = text;
    this.figures.title = more;
  }

  /** Options of a picker. @param {string} id @param {{value: string, label: string}[]} options @param {string} chosen */
  fill(id, options, chosen) {
    const picker = element(id);
    picker.replaceChildren(...options.map(({ value, label }) => new Option(label, value, false, value === chosen)));
    picker.closest("label").hidden = options.length < 2;
  }

  /** @param {boolean} runs Whether a camera or a video plays. */
  running(runs) {
    element("start").hidden = runs;
    element("stop").hidden = !runs;
    document.body.classList.toggle("running", runs);
    if (!runs) this.figure("");
  }
}
