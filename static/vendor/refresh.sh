#!/bin/sh
# Programs of others that /docs and /redoc use, from npm, at the versions below. Run this in static/vendor.
# Pictures inside the files are taken out, because the content security policy allows no data: addresses.
set -eu
work=$(mktemp -d)
here=$PWD
cd "$work"
npm pack --silent swagger-ui-dist@5.29.0 redoc@2.5.1 > /dev/null
for name in swagger-ui-dist redoc; do
    mkdir "$name"
    tar xzf "$name"-*.tgz -C "$name" --strip-components 1
done
cd "$here"
mkdir -p swagger-ui redoc
cp "$work"/swagger-ui-dist/LICENSE "$work"/swagger-ui-dist/NOTICE swagger-ui/
cp "$work"/swagger-ui-dist/swagger-ui.css "$work"/swagger-ui-dist/swagger-ui-bundle.js* swagger-ui/
rm -f swagger-ui/*.map
cp "$work"/redoc/LICENSE "$work"/redoc/bundles/redoc.standalone.js "$work"/redoc/bundles/redoc.standalone.js.LICENSE.txt redoc/
python3 - << 'END'
import base64
import re
from pathlib import Path

styles = Path("swagger-ui/swagger-ui.css")
text = re.sub(r'url\((?:"data:(?:\\.|[^"\\])*"|data:[^)]*)\)', "none", styles.read_text())
styles.write_text(re.sub(r"/\*# sourceMappingURL=.*?\*/", "", text))
script = Path("redoc/redoc.standalone.js")
(icon,) = set(re.findall(r"data:image/svg\+xml;base64,([A-Za-z0-9+/=]+)", script.read_text()))
Path("redoc/link.svg").write_bytes(base64.b64decode(icon))
text = script.read_text().replace(f"data:image/svg+xml;base64,{icon}", "/static/vendor/redoc/link.svg")
text = text.replace("https://cdn.redoc.ly/redoc/logo-mini.svg", "/static/vendor/redoc/link.svg")
script.write_text(re.sub(r"//# sourceMappingURL=\S+\s*\Z", "", text))
END
rm -r "$work"
