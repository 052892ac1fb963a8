// The maps of sessions from above: decoded when they come into view.

const sheets = new Map(); // session -> {bitmap} | {waiting}

function embedded(id) {
  const node = byId(id);
  return node ? node.textContent : "";
}

function blobOf(base64) {
  return new Blob([bytesOf(base64)], { type: "image/webp" });
}

/** The bitmap of a session's map, or null; `ready` is called when it has been decoded. */
function sheetOf(s, ready) {
  const known = sheets.get(s);
  if (known) return known.bitmap;
  if (!data.sessions[s].sheet) return null;
  const text = embedded(`sheet-${s}`);
  if (!text) return null; // not parsed yet
  const entry = { bitmap: null };
  sheets.set(s, entry);
  createImageBitmap(blobOf(text)).then((bitmap) => {
    entry.bitmap = bitmap;
    ready();
  }, () => {});
  return null;
}

/** The picture `id` as an image element; null where the page does not hold it. */
function pictureOf(id, text) {
  const base64 = embedded(id);
  if (!base64) return null;
  return el("img", { src: `data:image/webp;base64,${base64}`, alt: text, decoding: "async" });
}

/** Draw a session's map; the context must map metres of `frame_T_map` = {x, y, yaw} to pixels, y up. */
function drawSheet(context, s, pose, bitmap) {
  const { left, upper, width, height } = data.sessions[s].sheet;
  context.save();
  context.translate(pose.x, pose.y);
  context.rotate(pose.yaw);
  context.translate(left, upper);
  context.scale(width / bitmap.width, -height / bitmap.height);
  context.drawImage(bitmap, 0, 0);
  context.restore();
}
