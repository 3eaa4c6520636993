// Rules to begin with: those of docs/plans/rules-*.yaml. A test compares them.

/** @type {Record<string, any>} */
export const TEMPLATES = {
  rural_plates: {
    version: 1,
    name: "rural plates",
    applies: { road_class: "rural", speed_kmh: [30, 100] },
    road: { design_speed_kmh: 90, curve_radius_m: 400 },
    plates: { scheme: "id", n: 8, spacing_m: 100, offset_from_centre_m: 0, min_frames: 2, max_grade: 0.08 },
    decision_points: { at: ["stop_line", "junction", "curve"], before: "stopping_distance" },
    avoid: { layers: ["joints", "manholes", "crossings", "bridges"], clearance_m: 0.5 },
    cameras: [{ name: "front", width_px: 1920, height_px: 1080, horizontal_fov_deg: 70, height_m: 1.57, depression_deg: 23, frames_per_s: 120, exposure_s: 0.0005 }],
    quality: { fix_every_m: 100, fix_probability: 0.99, fix_error_m: 0.1 },
    costs: {
      currency: "EUR",
      items: [
        { item: "coded plate", per: "plate", price: 60, pay_item: "EX-101", source: "example" },
        { item: "recess and bond", per: "plate", price: 45, pay_item: "EX-102", source: "example" },
        { item: "lane closure", per: "day", price: 1800, pay_item: "EX-201", source: "example" },
      ],
      markers_per_day: 40,
    },
  },
  city_magnets: {
    version: 1,
    name: "city magnets",
    applies: { road_class: "urban", speed_kmh: [20, 50] },
    road: { design_speed_kmh: 50, curve_radius_m: 100 },
    lines: { solid: "N", dashed: "S", max_spacing_m: 6, along: "painted_line" },
    tags: {
      at: ["stop_line", "arrow", "curve", "speed_limit"], length_m: 4, segment_m: 0.5, magnets: 3, before: "reaction_distance", reaction_s: 2.5,
      min_before_m: 20, clearance_class: "utility",
    },
    avoid: { layers: ["joints", "manholes", "crossings"], clearance_m: 0.5, max_shift_m: 3 },
    installation: { hole_diameter_mm: 25, hole_depth_mm: 30 },
    costs: {
      currency: "USD",
      items: [
        { item: "magnet with shell", per: "magnet", price: 1, pay_item: "EX-301", source: "METRO section 8.1" },
        { item: "drill and bond", per: "hole", price: 4.5, pay_item: "EX-302", source: "example" },
      ],
      markers_per_day: 400,
    },
  },
  work_zone_cerpms: {
    version: 1,
    name: "work-zone CERPMs",
    applies: { road_class: "work_zone", speed_kmh: [40, 90] },
    road: { design_speed_kmh: 70 },
    cerpm: { marking_rules: "us-mutcd-11", sides: "both", n_m: 12.192, straight: 2, curve: 1, max_path_error_m: 0.05, preview_m: 340, collisions_max: 0.1, region: "US915" },
    temporary: { from: "2026-04-01", to: "2026-10-31" },
    costs: {
      currency: "USD",
      items: [
        { item: "CERPM", per: "cerpm", price: 35, pay_item: "EX-401", source: "example" },
        { item: "set and remove", per: "marker", price: 12, pay_item: "EX-402", source: "example" },
        { item: "mobilization", per: "plan", price: 5000, pay_item: "EX-001", source: "example" },
      ],
    },
  },
};
