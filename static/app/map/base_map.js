// A base map from a PMTiles file of the operator's: pictures, or vector tiles of any schema, drawn in quiet colours.

/**
 * @param {typeof import("maplibre-gl")} maplibre
 * @param {import("maplibre-gl").StyleSpecification} style To which the base map is added.
 * @param {string} url
 * @param {string} attribution
 * @param {ReturnType<typeof import("./symbols.js").pageColours>} colours
 */
export async function addPmtilesBase(maplibre, style, url, attribution, colours) {
  const { PMTiles, Protocol, TileType } = await import("pmtiles");
  const protocol = new Protocol();
  const address = new URL(url, window.location.href).href;
  const file = new PMTiles(address);
  protocol.add(file);
  maplibre.addProtocol("pmtiles", protocol.tile);
  const header = await file.getHeader();
  if (header.tileType !== TileType.Mvt) {
    style.sources.base = { type: "raster", url: `pmtiles://${address}`, tileSize: 256, attribution };
    style.layers.push({ id: "base", type: "raster", source: "base", paint: { "raster-opacity": 0.8 } });
    return;
  }
  style.sources.base = { type: "vector", url: `pmtiles://${address}`, attribution };
  const metadata = /** @type {{ vector_layers?: { id: string }[] }} */ (await file.getMetadata());
  for (const { id } of metadata.vector_layers ?? []) style.layers.push(...layersOf(id, colours));
}

/**
 * Layers of a vector tile by their names: Protomaps, OpenMapTiles and Shortbread call them alike.
 *
 * @param {string} name
 * @param {ReturnType<typeof import("./symbols.js").pageColours>} colours
 * @returns {import("maplibre-gl").LayerSpecification[]}
 */
function layersOf(name, colours) {
  const shared = { source: "base", "source-layer": name };
  const isArea = /water|ocean|land|park|forest|building|site/.test(name) && !/line|label|name/.test(name);
  /** @type {import("maplibre-gl").LayerSpecification[]} */
  const layers = [];
  if (isArea) {
    const opacity = /water|ocean/.test(name) ? 0.25 : /building/.test(name) ? 0.18 : 0.06;
    layers.push({ id: `base-${name}-area`, type: "fill", ...shared, filter: ["==", ["geometry-type"], "Polygon"], paint: { "fill-color": colours.soft, "fill-opacity": opacity } });
  }
  if (/road|street|transport|path|rail|boundar/.test(name)) {
    layers.push({
      id: `base-${name}-line`, type: "line", ...shared, filter: ["==", ["geometry-type"], "LineString"],
      paint: { "line-color": colours.line, "line-width": ["interpolate", ["exponential", 1.6], ["zoom"], 8, 0.5, 18, 10] },
    });
  }
  if (/place|label|name/.test(name)) {
    layers.push({
      id: `base-${name}-text`, type: "symbol", ...shared,
      layout: { "text-field": ["coalesce", ["get", "name"], ""], "text-size": 12, "text-font": ["sans-serif"] },
      paint: { "text-color": colours.soft, "text-halo-color": colours.ground, "text-halo-width": 1.5 },
    });
  }
  return layers;
}
