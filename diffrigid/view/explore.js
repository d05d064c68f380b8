// The sliders of `explore`, for anywidget, and the player in a frame, to which new motions are sent.

const STEPS = 400; // of a slider

function row(parent, { name, low, high, value, unit }, change) {
  const label = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
  label.style.cssText = "display: grid; grid-template-columns: 11em 1fr 8em; gap: 10px; align-items: center; font: 13px system-ui, sans-serif";
  Object.assign(input, { type: "range", min: low, max: high, step: (high - low) / STEPS, value });
  const write = (number) => { output.textContent = `${Number(number).toPrecision(4)} ${unit}`; };
  input.addEventListener("input", () => { write(input.value); change({ name, value: Number(input.value) }); });
  write(value);
  label.append(name, input, output);
  parent.append(label);
}

function render({ model, el }) {
  const frame = document.createElement("iframe");
  Object.assign(frame, { title: "player", srcdoc: model.get("page") });
  frame.setAttribute("sandbox", "allow-scripts");
  frame.style.cssText = "width: 100%; height: 460px; border: 0";
  for (const slider of model.get("sliders")) row(el, slider, (moved) => { model.set("moved", moved); model.save_changes(); });
  el.append(frame);
  const send = (end) => frame.contentWindow.postMessage({ runs: model.get("runs"), end }, "*");
  const ready = ({ source, data }) => { if (source === frame.contentWindow && data?.ready) send(true); };
  window.addEventListener("message", ready); // from the player, when it is there
  model.on("change:runs", () => send(false));
  return () => window.removeEventListener("message", ready);
}

export default { render };
