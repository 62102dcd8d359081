// Colour maps whose lightness increases evenly, so that they are readable without hue; interpolated between anchors.

const ANCHORS = {
  viridis: ["440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725"],
  cividis: ["00224e", "123570", "3b496c", "575d6d", "707173", "8a8678", "a59c74", "c3b369", "fee838"],
  grey: ["1c1c1c", "f5f5f5"],
};

// Return 256 colours as RGBA bytes, [256 × 4].
export function buildColourMap(name) {
  const anchors = ANCHORS[name].map((hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16)));
  const bytes = new Uint8ClampedArray(256 * 4);
  for (let k = 0; k < 256; k++) {
    const position = (k / 255) * (anchors.length - 1);
    const low = Math.min(Math.floor(position), anchors.length - 2);
    for (let channel = 0; channel < 3; channel++) {
      const [start, end] = [anchors[low][channel], anchors[low + 1][channel]];
      bytes[4 * k + channel] = start + (end - start) * (position - low);
    }
    bytes[4 * k + 3] = 255;
  }
  return bytes;
}

// Return a colour of colours.css in the current theme, for canvases.
export function readThemeColour(name) {
  const probe = document.body.appendChild(document.createElement("i"));
  probe.hidden = true;
  probe.style.color = `var(--${name})`;
  const colour = getComputedStyle(probe).color;
  probe.remove();
  return colour;
}
