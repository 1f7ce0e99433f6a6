#!/usr/bin/env bash
# Makes three.min.js anew: three.js 0.187.0 (MIT, see LICENSE), what entry.js names of it, in one module without imports.
# Needed only for another version or another name in entry.js; users need neither Node.js nor this.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init --yes >/dev/null
npm install --silent --no-audit --no-fund three@0.187.0 esbuild@0.28.2
cp "$here/entry.js" .
npx esbuild entry.js --bundle --format=esm --minify --legal-comments=inline --outfile="$here/three.min.js"
cp node_modules/three/LICENSE "$here/LICENSE"
