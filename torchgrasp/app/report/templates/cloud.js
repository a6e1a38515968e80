// Point clouds that are dropped on the page or chosen: .ply and .pcd (text or binary), or text with a point a line.
const NUMBERS = { char: [1, "Int8"], uchar: [1, "Uint8"], short: [2, "Int16"], ushort: [2, "Uint16"], int: [4, "Int32"],
  uint: [4, "Uint32"], float: [4, "Float32"], double: [8, "Float64"], int8: [1, "Int8"], uint8: [1, "Uint8"],
  int16: [2, "Int16"], uint16: [2, "Uint16"], int32: [4, "Int32"], uint32: [4, "Uint32"], float32: [4, "Float32"],
  float64: [8, "Float64"], I1: [1, "Int8"], I2: [2, "Int16"], I4: [4, "Int32"], U1: [1, "Uint8"], U2: [2, "Uint16"],
  U4: [4, "Uint32"], F4: [4, "Float32"], F8: [8, "Float64"] };
const MOST_POINTS = 200000;

/* The points of a file as [x, y, z, x, y, ...]; an Error says what is wrong with it. */
function readCloud(name, buffer) {
  const begin = new TextDecoder("latin1").decode(new Uint8Array(buffer, 0, Math.min(buffer.byteLength, 65536)));
  if (/^ply\s/.test(begin)) return readPly(begin, buffer);
  if (/^(#[^\n]*\n)*\s*(VERSION|FIELDS)\s/i.test(begin)) return readPcd(begin, buffer);
  if (begin.includes("\0")) throw new Error(`${name} is neither .ply, .pcd nor text`);
  return readRows(new TextDecoder().decode(buffer), [0, 1, 2]);
}

function readPly(begin, buffer) {
  const end = /end_header\r?\n/.exec(begin);
  if (!end) throw new Error("the header of the .ply does not end");
  const words = begin.slice(0, end.index).split(/\r?\n/).map((line) => line.trim().split(/\s+/));
  const format = (words.find((w) => w[0] === "format") || [])[1], elements = [];
  for (const w of words) {
    if (w[0] === "element") elements.push({ name: w[1], count: Number(w[2]), fields: [] });
    if (w[0] === "property" && elements.length) elements[elements.length - 1].fields.push({ name: w[w.length - 1].toLowerCase(), kind: w[1] });
  }
  const vertex = elements[0];
  if (!vertex || vertex.name !== "vertex") throw new Error("the .ply does not begin with vertices");
  return readBody(buffer, end.index + end[0].length, vertex.fields, vertex.count, format === "ascii", format !== "binary_big_endian");
}

function readPcd(begin, buffer) {
  const end = /^DATA\s+(\w+)[^\n]*\n/im.exec(begin);
  if (!end) throw new Error("the header of the .pcd does not end");
  const values = (key) => ((new RegExp(`^${key}\\s+(.*)$`, "im").exec(begin) || [])[1] || "").trim().split(/\s+/);
  if (!["ascii", "binary"].includes(end[1].toLowerCase())) throw new Error(`a .pcd with data ${end[1]}; save it as ascii or binary`);
  const sizes = values("SIZE"), types = values("TYPE"), counts = values("COUNT");
  const fields = values("FIELDS").flatMap((name, k) => Array.from({ length: Number(counts[k]) || 1 }, (_, part) =>
    ({ name: part ? "" : name.toLowerCase(), kind: types[k] + sizes[k] })));
  return readBody(buffer, end.index + end[0].length, fields, Number(values("POINTS")[0]), end[1].toLowerCase() === "ascii", true);
}

/* The x, y and z of `count` rows that begin at a byte. */
function readBody(buffer, start, fields, count, text, little) {
  const columns = ["x", "y", "z"].map((name) => fields.findIndex((field) => field.name === name));
  if (columns.includes(-1)) throw new Error("the file has no x, y and z");
  if (text) return readRows(new TextDecoder().decode(new Uint8Array(buffer, start)), columns, count);
  let width = 0;
  for (const field of fields) {
    if (!NUMBERS[field.kind]) throw new Error(`a vertex has ${field.kind} ${field.name}, which this page cannot read`);
    field.at = width;
    width += NUMBERS[field.kind][0];
  }
  if (!(count >= 1) || start + count * width > buffer.byteLength) throw new Error("the file is shorter than its header says");
  const view = new DataView(buffer, start), points = [];
  for (let row = 0; row < count; row++) {
    for (const column of columns) points.push(view[`get${NUMBERS[fields[column].kind][1]}`](row * width + fields[column].at, little));
  }
  return points;
}

/* Lines with fewer numbers, such as heads and counts, are left out; `most` is the number of rows to read. */
function readRows(text, columns, most = Infinity) {
  const points = [], last = Math.max(...columns);
  for (const line of text.split("\n")) {
    if (points.length >= 3 * most) break;
    const words = line.trim().split(/[\s,;]+/), numbers = columns.map((column) => Number(words[column]));
    if (words.length > last && words[0] !== "" && numbers.every((x) => !Number.isNaN(x))) points.push(...numbers);
  }
  return points;
}

/* Show a file as a layer, in the frame of the page's own cloud; `say` gets a sentence about it. */
async function openCloud(file, say) {
  try {
    let points = readCloud(file.name, await file.arrayBuffer());
    const rows = Math.floor(points.length / 3), step = Math.ceil(rows / MOST_POINTS);
    points = points.filter((_, k) => Math.floor(k / 3) % step === 0);
    const finite = Array.from({ length: points.length / 3 }, (_, k) => points.slice(3 * k, 3 * k + 3)).filter((p) => p.every(Number.isFinite));
    if (!finite.length) throw new Error("no line has three numbers");
    const shape = new THREE.BufferGeometry();
    shape.setAttribute("position", new THREE.BufferAttribute(new Float32Array(finite.flat()), 3));
    shape.computeBoundingBox();
    const size = shape.boundingBox.getSize(new THREE.Vector3()), cloud = dots(shape, "#7a3fa0");
    cloud.applyMatrix4(frame.matrix);
    layers["opened cloud"].clear().add(cloud);
    const ball = new THREE.Box3().setFromObject(cloud).getBoundingSphere(new THREE.Sphere());
    camera.far = Math.max(60 * sphere.radius, 20 * ball.radius + ball.center.distanceTo(sphere.center));
    camera.updateProjectionMatrix();
    for (const chosen of Object.values(wanted)) chosen.add("opened cloud");
    document.body.dataset.opened = finite.length;
    show({});
    look(ball.center, ball.radius);
    const unit = size.length() > 5 ? " It is large: its unit may be millimetres (--unit mm)." : "";
    say(`${file.name}: ${rows} points, ${size.toArray().map((x) => x.toFixed(3)).join(" x ")} m.${unit} Plan with: torchgrasp grasp ${file.name}`);
  } catch (failure) {
    say(`${file.name}: ${failure.message}.`);
  }
}
