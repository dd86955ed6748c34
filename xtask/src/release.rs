//! `cargo xtask release`: one folder with everything that a lab without a Rust toolchain needs.
//!
//! The images lie beside the tool, not in it: `probe-rs` needs them as files, and `doctor` tells by their marks whether
//! they are those of the tool.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::process::{Failure, Result, image_cargo, root, run, target};
use crate::{bench, images, python};

/// What the tool is built for, without shared libraries.
const MUSL: [&str; 2] = ["x86_64-unknown-linux-musl", "aarch64-unknown-linux-musl"];

const REMEDY: &str = "read the output above; Rust has to come from rustup";

/// Files that are handed out as they are, and the images: without what only a debugger needs, and as Intel hex. A plain
/// binary would overwrite the settings, which lie between the vector table and the code.
const FILES: &str = r#"
cp CHANGELOG.md CITATION.cff LICENSE-APACHE LICENSE-MIT SECURITY.md docs/install.md docs/records.schema.json \
   docs/60-st-link.rules examples/paper.toml "$OUT"
tools=$(dirname "$(rustc --print target-libdir)")/bin
for image in "$IMAGES"/firmware-rig "$IMAGES"/firmware-capsule; do
    "$tools/rust-objcopy" --strip-all "$image" "$OUT/${image##*/}.elf"
    "$tools/rust-objcopy" --output-target=ihex "$image" "$OUT/${image##*/}.hex"
done
"#;

/// Each crate of others in the tool and in the images, with its licence.
const NOTICES: &str = r#"
tree() { cargo tree --locked --edges normal --prefix none --format '{p} |{l}|' "$@"; }
{
    echo 'The tool and the images contain the standard library of Rust (MIT OR Apache-2.0), the tool musl (MIT).'
    { tree --package host-tool --target x86_64-unknown-linux-musl
      tree --package firmware-rig --package firmware-capsule --target thumbv7em-none-eabihf
    } | cut -d '|' -f 1,2 | sort -u | while IFS=' |' read -r name version more; do
        folder=$(echo "$CRATES"/*/"$name-${version#v}")
        # What cargo has not fetched is ours.
        [ -d "$folder" ] || continue
        printf '\n\n== %s %s, %s\n\n' "$name" "$version" "${more##*|}"
        cat "$folder"/[Ll][Ii][Cc][Ee][Nn]* "$folder"/COPYING* "$folder"/NOTICE* 2> /dev/null || true
    done
} > "$OUT/THIRD-PARTY.txt"
"#;

/// The sources, with those of the emulator: it is young, and versions of it were withdrawn. Their configuration, which
/// ends with the table of variables, knows the commit.
const SOURCES: &str = r#"
rm -rf "$SOURCE" && mkdir -p "$SOURCE/vendor"
git archive HEAD | tar -x -C "$SOURCE"
emulator=$(cargo pkgid rigless)
cp -r "$CRATES"/*/"rigless-${emulator##*@}" "$SOURCE/vendor/rigless"
printf 'RETROGRADE_COMMIT = "%s"\n\n[patch.crates-io]\nrigless = { path = "vendor/rigless" }\n' \
    "$(git rev-parse HEAD)" >> "$SOURCE/.cargo/config.toml"
tar -cz --owner=0 --group=0 -f "$OUT/${SOURCE##*/}-source.tar.gz" -C "$SOURCE/.." "${SOURCE##*/}"
"#;

const SUMS: &str = r#"
cd "$OUT" && find * -type f ! -name SHA256SUMS | LC_ALL=C sort | xargs sha256sum > SHA256SUMS
"#;

/// Builds everything into `target/retrograde-VERSION`.
///
/// # Errors
/// Uncommitted changes, a target that cannot be had, or a build that fails.
pub(crate) fn make() -> Result<()> {
    let name = concat!("retrograde-", env!("CARGO_PKG_VERSION"));
    let folder = target().join(name);
    let remedy = "commit or undo the changes: a release names its commit";
    script(&folder, "git diff --quiet HEAD", remedy)?;
    // Nothing of an earlier attempt may be part of it.
    script(&folder, r#"rm -rf "$OUT" && mkdir -p "$OUT""#, REMEDY)?;
    images::build()?;
    script(&folder, FILES, REMEDY)?;
    for triple in MUSL {
        tool(triple, &folder)?;
    }
    let mut wheel = Command::new(python::tool("build", "1.3.0", "pyproject-build")?);
    wheel
        .arg("--outdir")
        .arg(&folder)
        .arg(root().join("python"));
    run(&mut wheel, REMEDY)?;
    let sample = folder.join("sample").display().to_string();
    bench::run_command("demo", &["--out".to_owned(), sample])?;
    for text in [NOTICES, SOURCES, SUMS] {
        script(&folder, text, REMEDY)?;
    }
    println!("{}", folder.display());
    Ok(())
}

/// Runs a script in the workspace's folder.
fn script(out: &Path, text: &str, remedy: &str) -> Result<()> {
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(std::env::home_dir()?.join(".cargo")));
    let image = images::find("rig")?;
    let mut shell = Command::new("sh");
    shell.current_dir(root()).args(["-euc", text]);
    shell
        .env("OUT", out)
        .env("IMAGES", image.with_file_name(""));
    shell.env(
        "SOURCE",
        target()
            .join("source")
            .join(out.file_name().unwrap_or_default()),
    );
    shell.env("CRATES", home.unwrap_or_default().join("registry/src"));
    run(&mut shell, remedy)
}

/// The tool, as `retrograde-PROCESSOR`.
fn tool(triple: &str, folder: &Path) -> Result<()> {
    let mut rustup = Command::new("rustup");
    run(rustup.args(["target", "add", triple]), REMEDY)?;
    let mut cargo = image_cargo("build");
    cargo.args(["--locked", "--profile", "dist", "--package", "host-tool"]);
    cargo
        .args(["--target", triple, "--target-dir"])
        .arg(target());
    let linker = triple.to_uppercase().replace('-', "_");
    cargo.env(format!("CARGO_TARGET_{linker}_LINKER"), "rust-lld");
    run(&mut cargo, REMEDY)?;
    let processor = triple.split('-').next().unwrap_or_default();
    let built = target().join(triple).join("dist/retrograde");
    let copied = std::fs::copy(built, folder.join(format!("retrograde-{processor}")));
    copied
        .map(drop)
        .map_err(|why| Failure::new(why.to_string(), REMEDY))
}
