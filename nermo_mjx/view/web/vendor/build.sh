#!/usr/bin/env bash
# Makes the page's libraries anew, each one module without imports: three.js 0.187.0, what three/entry.js names of it, and
# the simplifier of meshoptimizer 1.3.0 (both MIT, see LICENSE beside them). Needed only for another version or another
# name in entry.js; users need neither Node.js nor this.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm init --yes >/dev/null
npm install --silent --no-audit --no-fund three@0.187.0 meshoptimizer@1.3.0 esbuild@0.28.2
cp "$here/three/entry.js" .
bundle() { npx esbuild "$1" --bundle --format=esm --minify --legal-comments=inline --outfile="$2"; }
bundle entry.js "$here/three/three.min.js"
bundle node_modules/meshoptimizer/meshopt_simplifier.js "$here/meshoptimizer/simplifier.min.js"
cp node_modules/three/LICENSE "$here/three/LICENSE"
cp node_modules/meshoptimizer/LICENSE.md "$here/meshoptimizer/LICENSE"
