"""What QGIS finds in a Waymark server, as JSON on the standard output. Run by the Python that has QGIS, not by pytest.

Arguments: the server's URL, a key, an empty folder for the profile and for pictures, the style of the tiles as a file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsAuthMethodConfig,
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsDataSourceUri,
    QgsFeatureRequest,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProject,
    QgsRectangle,
    QgsVectorDataProvider,
    QgsVectorLayer,
    QgsVectorTileLayer,
)
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor

URL, KEY, FOLDER, STYLE = sys.argv[1], sys.argv[2], Path(sys.argv[3]), sys.argv[4]
EDITS = {
    "add": QgsVectorDataProvider.AddFeatures,
    "change": QgsVectorDataProvider.ChangeAttributeValues,
    "move": QgsVectorDataProvider.ChangeGeometries,
    "delete": QgsVectorDataProvider.DeleteFeatures,
}


def basic_auth() -> str:
    """Id of an authentication configuration with the key as the password."""
    manager = QgsApplication.authManager()
    assert manager.setMasterPassword("of this profile", True)
    config = QgsAuthMethodConfig("Basic")
    config.setName("waymark")
    config.setConfig("username", "anybody")
    config.setConfig("password", KEY)
    assert manager.storeAuthenticationConfig(config)[0]
    return str(config.id())


def opened(name: str, auth: str, **parameters: str) -> QgsVectorLayer:
    """A collection as a layer of QGIS's own provider."""
    uri = QgsDataSourceUri()
    uri.setParam("url", f"{URL}/ogc")
    uri.setParam("typename", name)
    uri.setAuthConfigId(auth)
    for parameter, value in parameters.items():
        uri.setParam(parameter, value)
    return QgsVectorLayer(uri.uri(False), name, "OAPIF")


def described(layer: QgsVectorLayer) -> dict[str, Any]:
    """A layer's geometry and fields."""
    return {
        "valid": layer.isValid(),
        "geometry": layer.wkbType(),
        "fields": {field.name(): field.typeName() for field in layer.fields()},
    }


def drawn(layer: Any, path: Path, west: float, south: float, east: float, north: float) -> list[str]:
    """Draw a layer to a picture; what went wrong."""
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setOutputSize(QSize(900, 600))
    settings.setBackgroundColor(QColor(238, 238, 238))
    settings.setDestinationCrs(QgsCoordinateReferenceSystem("EPSG:3857"))
    to_map = QgsCoordinateTransform(
        QgsCoordinateReferenceSystem("EPSG:4326"), settings.destinationCrs(), QgsProject.instance()
    )
    settings.setExtent(to_map.transformBoundingBox(QgsRectangle(west, south, east, north)))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    assert job.renderedImage().save(str(path))
    return [error.message for error in job.errors()]


def session() -> dict[str, Any]:
    """Everything that the test asks about."""
    auth = basic_auth()
    found: dict[str, Any] = {"version": Qgis.QGIS_VERSION_INT}
    markers = opened("markers", auth, pageSize="10", maxNumFeatures="10000")
    found["markers"] = described(markers)
    found["count"] = markers.featureCount()
    found["places"] = {
        feature["id"]: [feature.geometry().asPoint().x(), feature.geometry().asPoint().y()]
        for feature in markers.getFeatures()
    }
    box = QgsFeatureRequest(QgsRectangle(8.4005, 48.999, 8.4025, 49.0005))
    found["in box"] = sorted(feature["id"] for feature in markers.getFeatures(box))
    assert markers.setSubsetString("road = 'A1' AND measure_m >= 10")
    found["subset"] = sorted(feature["id"] for feature in markers.getFeatures())
    assert markers.setSubsetString("")
    found["first"] = {
        name: value if isinstance(value, (str, int, float)) else str(value)
        for name, value in zip(found["markers"]["fields"], next(markers.getFeatures()).attributes())  # noqa: B905
    }
    found["empty"] = described(opened("plans", auth))
    found["empty through GDAL"] = described(
        QgsVectorLayer(f"OAPIF:{URL}/ogc|layername=plans authcfg='{auth}'", "plans", "ogr")
    )
    capabilities = int(markers.dataProvider().capabilities())
    found["edits"] = {name: bool(capabilities & int(flag)) for name, flag in EDITS.items()}
    found["refused"] = described(opened("markers", ""))
    area = (8.398, 48.998, 8.414, 49.006)
    found["errors"] = drawn(markers, FOLDER / "features.png", *area)
    tiles = f"{URL}/ogc/collections/markers/tiles/WebMercatorQuad/%7Bz%7D/%7By%7D/%7Bx%7D"
    layer = QgsVectorTileLayer(f"type=xyz&url={tiles}&zmin=0&zmax=24&authcfg={auth}&styleUrl={STYLE}", "tiles")
    found["tiles"] = layer.isValid()
    found["style"] = layer.loadDefaultStyle()
    found["styles"] = [style.styleName() for style in layer.renderer().styles()]
    found["errors"] += drawn(layer, FOLDER / "tiles.png", *area)
    return found


if __name__ == "__main__":
    application = QgsApplication([], False, str(FOLDER / "profile"))
    application.initQgis()
    print("RESULT " + json.dumps(session()))
    sys.stdout.flush()
    application.exitQgis()
