#!/bin/sh
# Programs of others that the web pages use, from npm at the versions of package-lock.json. Run from anywhere.
# To move to a newer version: npm install --save-dev NAME@VERSION, then this script.
set -eu
cd "$(dirname "$0")/../.."
npm ci --no-audit --no-fund
node static/vendor/refresh.mjs
