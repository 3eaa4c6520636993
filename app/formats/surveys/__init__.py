"""Survey files: CSV, GeoJSON, GeoPackage, Shapefile, KML, LandXML and DXF."""
