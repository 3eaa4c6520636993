// What vehicles saw of one marker.

import { html } from "htm/preact";

import { api, ok, page } from "../api/client.js";
import { Facts } from "../components/facts.js";
import { Empty, Shown, useLoad } from "../components/load.js";
import { number, time } from "../format.js";
import { t, textOr } from "../texts/index.js";

/** @param {{ id: string }} props */
export function HealthOf({ id }) {
  const found = useLoad(async (signal) => {
    const params = { path: { marker_id: id } };
    const [health, observations] = await Promise.all([
      ok(api.GET("/v1/markers/{marker_id}/health", { params, signal })),
      page(api.GET("/v1/markers/{marker_id}/observations", { params: { ...params, query: { limit: 20 } }, signal })),
    ]);
    return { health, observations: observations.items };
  }, [id]);
  return html`<${Shown} of=${found}>${(/** @type {any} */ { health, observations }) => html`
    ${health.passes === 0 && !observations.length
      ? html`<${Empty} title=${t("health.none")} />`
      : html`
        <${Facts} of=${[
          [t("health.passes"), String(health.passes)],
          [t("health.reads"), String(health.reads)],
          [t("health.quality"), health.quality === null ? null : number(100 * health.quality, 0, "%")],
          [t("health.read_at"), health.read_at && `${time(health.read_at)} UTC`],
          [t("health.last_at"), health.last_at && `${time(health.last_at)} UTC`],
          ...Object.entries(health.ratios).map(([name, ratio]) => /** @type {[string, any]} */ ([textOr(`observation.${name}`, name), ratioText(ratio, health.limits[name])])),
        ]} />
        ${observations.length > 0 && html`
          <h4>${t("health.last")}</h4>
          <ul class="plain">${observations.map((/** @type {any} */ one) => html`<li>${time(one.at)} UTC: ${textOr(`observation.${one.what}`, one.what)} <a href=${`/decodes/${one.decode_id}`}>${t("health.decode")}</a></li>`)}</ul>
        `}
      `}
  `}</${Shown}>`;
}

/** @param {any} ratio @param {number | undefined} limit */
const ratioText = (ratio, limit) => (limit === undefined ? number(Number(ratio), 2) : t("health.ratio", { ratio: number(Number(ratio), 2), limit: number(limit, 2) }));
