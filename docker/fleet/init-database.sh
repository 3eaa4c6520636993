#!/bin/sh
# Run once by the database's image: the role of Waymark is no superuser, so that row level security binds it.
set -eu
password=$(cat /run/secrets/waymark_role_password)
psql -v ON_ERROR_STOP=1 -v password="$password" -U postgres <<'SQL'
CREATE ROLE waymark LOGIN PASSWORD :'password';
CREATE DATABASE waymark OWNER waymark ENCODING 'UTF8' TEMPLATE template0;
\connect waymark
CREATE EXTENSION IF NOT EXISTS postgis;
ALTER FUNCTION geometry_overlaps(geometry, geometry) LEAKPROOF;
GRANT CREATE, USAGE ON SCHEMA public TO waymark;
SQL
