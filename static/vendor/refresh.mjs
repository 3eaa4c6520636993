// Copies the vendored programs out of node_modules into static/vendor/NAME-VERSION/, compresses each file, and writes
// the versions into the HTML files: addresses of vendored files, and the import map of index.html.
//
// - Source maps are left out, and pictures inside of files are taken out: the content security policy allows no data: addresses.
// - Folders carry the version, so the server can let browsers keep the files for ever (app/api/http/ui.py).

import { createHash } from "node:crypto";
import fs from "node:fs";
import path from "node:path";
import { fileURLToPath } from "node:url";
import zlib from "node:zlib";

const VENDOR = path.dirname(fileURLToPath(import.meta.url));
const STATIC = path.dirname(VENDOR);
const MODULES = path.join(path.dirname(STATIC), "node_modules");

/**
 * Each program: its npm package, the name of its folder, files to copy (source: target), its licence, and the names by
 * which modules import its files.
 */
const PROGRAMS = [
  {
    npm: "preact",
    files: { "dist/preact.mjs": "preact.js", "hooks/dist/hooks.mjs": "hooks.js" },
    licence: "LICENSE",
    imports: { preact: "preact.js", "preact/hooks": "hooks.js" },
  },
  {
    npm: "htm",
    files: { "dist/htm.module.js": "htm.js", "preact/index.module.js": "preact.js" },
    licence: "LICENSE",
    imports: { htm: "htm.js", "htm/preact": "preact.js" },
  },
  {
    npm: "@preact/signals-core",
    folder: "signals-core",
    files: { "dist/signals-core.module.js": "signals-core.js" },
    licence: "LICENSE",
    imports: { "@preact/signals-core": "signals-core.js" },
  },
  {
    npm: "@preact/signals",
    folder: "signals",
    files: { "dist/signals.module.js": "signals.js" },
    licence: "LICENSE",
    imports: { "@preact/signals": "signals.js" },
  },
  {
    npm: "openapi-fetch",
    files: { "dist/index.mjs": "openapi-fetch.js" },
    licence: "LICENSE",
    imports: { "openapi-fetch": "openapi-fetch.js" },
  },
  {
    npm: "maplibre-gl",
    files: {
      "dist/maplibre-gl.mjs": "maplibre-gl.js",
      "dist/maplibre-gl-worker.mjs": "maplibre-gl-worker.js",
      "dist/maplibre-gl.css": "maplibre-gl.css",
    },
    licence: "LICENSE.txt",
    imports: {
      "maplibre-gl": "maplibre-gl.js",
      "maplibre-gl/worker": "maplibre-gl-worker.js",
      "maplibre-gl/style": "maplibre-gl.css",
    },
  },
  {
    npm: "terra-draw",
    files: { "dist/terra-draw.modern.js": "terra-draw.js" },
    licence: "licences/terra-draw.txt",
    imports: { "terra-draw": "terra-draw.js" },
  },
  {
    npm: "terra-draw-maplibre-gl-adapter",
    files: { "dist/terra-draw-maplibre-gl-adapter.modern.js": "adapter.js" },
    licence: "licences/terra-draw.txt",
    imports: { "terra-draw-maplibre-gl-adapter": "adapter.js" },
  },
  {
    npm: "uplot",
    files: { "dist/uPlot.esm.js": "uplot.js", "dist/uPlot.min.css": "uplot.css" },
    licence: "LICENSE",
    imports: { uplot: "uplot.js", "uplot/style": "uplot.css" },
  },
  {
    npm: "pmtiles",
    files: { "dist/esm/index.js": "pmtiles.js" },
    licence: "licences/pmtiles.txt",
    imports: { pmtiles: "pmtiles.js" },
  },
  {
    npm: "fflate",
    files: { "esm/browser.js": "fflate.js" },
    licence: "LICENSE",
    imports: { fflate: "fflate.js" },
  },
  {
    npm: "swagger-ui-dist",
    folder: "swagger-ui",
    files: {
      "swagger-ui-bundle.js": "swagger-ui-bundle.js",
      "swagger-ui.css": "swagger-ui.css",
      "swagger-ui-bundle.js.LICENSE.txt": "swagger-ui-bundle.js.LICENSE.txt",
      NOTICE: "NOTICE",
    },
    licence: "LICENSE",
  },
  {
    npm: "redoc",
    files: {
      "bundles/redoc.standalone.js": "redoc.standalone.js",
      "bundles/redoc.standalone.js.LICENSE.txt": "redoc.standalone.js.LICENSE.txt",
    },
    licence: "LICENSE",
    patch: patchRedoc,
  },
];

function main() {
  for (const entry of fs.readdirSync(VENDOR, { withFileTypes: true })) {
    if (entry.isDirectory() && entry.name !== "licences") fs.rmSync(path.join(VENDOR, entry.name), { recursive: true });
  }
  const imports = {};
  const folders = {};
  for (const program of PROGRAMS) {
    const { version } = JSON.parse(fs.readFileSync(path.join(MODULES, program.npm, "package.json"), "utf8"));
    const name = program.folder ?? program.npm;
    folders[name] = `${name}-${version}`;
    copy(program, folders[name]);
    for (const [specifier, file] of Object.entries(program.imports ?? {})) {
      imports[specifier] = `/static/vendor/${folders[name]}/${file}`;
    }
  }
  for (const page of ["index.html", "docs.html", "redoc.html"]) writeVersions(path.join(STATIC, page), folders, imports);
}

function copy(program, folder) {
  const target = path.join(VENDOR, folder);
  fs.mkdirSync(target);
  const licence = program.licence.startsWith("licences/") ? VENDOR : path.join(MODULES, program.npm);
  fs.copyFileSync(path.join(licence, program.licence), path.join(target, "LICENSE"));
  for (const [source, name] of Object.entries(program.files)) {
    let text = fs.readFileSync(path.join(MODULES, program.npm, source), "utf8");
    if (name.endsWith(".js")) text = text.replace(/\/\/# sourceMappingURL=\S+\s*$/, "");
    if (name.endsWith(".css")) text = text.replace(/\/\*# sourceMappingURL=.*?\*\//, "");
    if (name.endsWith(".css")) text = withoutPictures(text, target, `/static/vendor/${folder}`);
    if (program.patch && name.endsWith(".js")) text = program.patch(text, target, `/static/vendor/${folder}`);
    fs.writeFileSync(path.join(target, name), text);
  }
  for (const name of fs.readdirSync(target)) if (/\.(js|css|svg)$/.test(name)) compress(path.join(target, name));
}

/** Pictures of a style sheet become files. */
function withoutPictures(css, target, address) {
  return css.replace(/url\((?:"data:((?:\\.|[^"\\])*)"|'data:([^']*)'|data:([^)]*))\)/g, (_, double, single, bare) => {
    const [head, ...rest] = (double ?? single ?? bare).replace(/\\"/g, '"').split(",");
    if (!head.startsWith("image/svg+xml")) return "none";
    const body = rest.join(",");
    const svg = head.endsWith(";base64") ? Buffer.from(body, "base64").toString() : decodeURIComponent(body);
    const name = `${createHash("sha256").update(svg).digest("hex").slice(0, 12)}.svg`;
    fs.writeFileSync(path.join(target, name), svg);
    return `url("${address}/${name}")`;
  });
}

/** Redoc's logo is a file of ours instead of one from another host. */
function patchRedoc(text, target, address) {
  const [icon, ...others] = new Set(text.match(/data:image\/svg\+xml;base64,[A-Za-z0-9+/=]+/g));
  if (!icon || others.length) throw new Error("redoc: one picture was expected");
  fs.writeFileSync(path.join(target, "link.svg"), Buffer.from(icon.split(",")[1], "base64"));
  return text.replaceAll(icon, `${address}/link.svg`).replaceAll("https://cdn.redoc.ly/redoc/logo-mini.svg", `${address}/link.svg`);
}

function compress(file) {
  const content = fs.readFileSync(file);
  if (content.length < 1024) return;
  fs.writeFileSync(`${file}.gz`, zlib.gzipSync(content, { level: 9 }));
  fs.writeFileSync(`${file}.br`, zlib.brotliCompressSync(content, { params: { [zlib.constants.BROTLI_PARAM_QUALITY]: 11 } }));
}

function writeVersions(page, folders, imports) {
  let text = fs.readFileSync(page, "utf8");
  for (const [name, folder] of Object.entries(folders)) {
    text = text.replace(new RegExp(`/static/vendor/${name}(-\\d[^/"]*)?/`, "g"), `/static/vendor/${folder}/`);
  }
  const map = JSON.stringify({ imports }, null, 2);
  text = text.replace(/(<script type="importmap">)[^<]*(<\/script>)/, (_, start, end) => `${start}\n${map}\n${end}`);
  fs.writeFileSync(page, text);
}

main();
