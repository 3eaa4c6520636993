"""/ogc: OGC API Features and Tiles, for QGIS, GDAL and their kin."""

from app.api.ogc.routes import mount_ogc

__all__ = ["mount_ogc"]
