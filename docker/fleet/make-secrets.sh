#!/bin/sh
# Write the secrets of docker/compose.fleet.yaml, once: random, for the owner of the files only.
#   sh docker/fleet/make-secrets.sh [FOLDER]
set -eu
folder=${1:-"$(dirname "$0")/secrets"}
umask 077
mkdir -p "$folder"
cd "$folder"
if [ -e waymark_database_url ]; then
    echo "$folder has secrets already" >&2
    exit 1
fi
random() { od -An -tx1 -N24 /dev/urandom | tr -d ' \n'; }
database=$(random) broker=$(random) store_id=$(random) store_key=$(random)
printf %s "$(random)" > postgres_password
printf %s "$database" > waymark_role_password
printf %s "postgresql+psycopg://waymark:$database@db:5432/waymark" > waymark_database_url
printf 'default_user = waymark\ndefault_pass = %s\n' "$broker" > rabbitmq_user.conf
printf %s "amqp://waymark:$broker@broker:5672//" > waymark_broker_url
printf %s "$store_id" > aws_access_key_id
printf %s "$store_key" > aws_secret_access_key
printf '{"identities": [{"name": "waymark", "credentials": [{"accessKey": "%s", "secretKey": "%s"}], "actions": ["Admin", "Read", "Write", "List", "Tagging"]}]}' \
    "$store_id" "$store_key" > s3.json
head -c 32 /dev/urandom > master.key
head -c 32 /dev/urandom > signing.key
printf %s "$(random)" > waymark_admin_key
# containers run as other users than the owner of these files; the folder keeps everybody else out
chmod 0444 ./*
chmod 0711 .
