//! Pictures of the page and of a trial's report, taken in a Chromium while both machines work on the virtual bench.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::channel;
use std::thread;
use std::time::Duration;

use crate::images;
use crate::process::{Failure, Result, host_cargo, root, run, target};

/// Name, width and height, and what else the browser is told.
type Picture = (&'static str, u32, u32, &'static [&'static str]);
const OF_PAGE: [Picture; 3] = [
    ("page.png", 1200, 1180, &[]),
    ("page-dark.png", 1200, 1180, &["--force-dark-mode"]),
    // The least width of a window is 500.
    ("page-narrow.png", 500, 980, &[]),
];
const OF_TRIAL: Picture = ("trial.png", 1000, 1250, &[]);

/// Path of the page, and of the hash of the page that the pictures show.
const PAGE: &str = "host-tool/serve/src/page.html";
const HASH: &str = "docs/pictures/page.sha256";

fn hash_of_page() -> String {
    let page = std::fs::read(root().join(PAGE)).unwrap_or_default();
    let hash = hmac_sha256::Hash::hash(&page);
    hash.iter()
        .map(|byte| format!("{byte:02x}"))
        .collect::<String>()
        + "\n"
}

/// A process that ends with this value.
struct Ends(Child);

impl Drop for Ends {
    fn drop(&mut self) {
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// Programs and places of one session.
struct Session<'a> {
    browser: &'a Path,
    folder: PathBuf,
    places: [(&'static str, String); 2],
}

/// Takes all of them with this browser.
///
/// # Errors
/// A program that does not do what it is asked.
pub(super) fn take(browser: &Path) -> Result<()> {
    images::build()?;
    let mut build = host_cargo("build");
    build.args(["--locked", "--ignore-rust-version"]);
    build.args(["--package", "host-tool", "--package", "virtual-bench"]);
    run(&mut build, "see the compiler's message")?;
    let folder = target().join("pictures");
    drop(std::fs::remove_dir_all(&folder));
    let mut bench = program("virtual-bench");
    bench.args(["serve", "--rig", "0", "--capsule", "0"]);
    let (_bench, said) = start(&mut bench, &["--rig tcp:", "--capsule tcp:"])?;
    let place = |nth: usize| said[nth].rsplit(' ').next().unwrap_or_default().to_owned();
    let session = Session {
        browser,
        folder,
        places: [
            ("RETROGRADE_RIG", place(0)),
            ("RETROGRADE_CAPSULE", place(1)),
        ],
    };
    for words in [&["home"][..], &["capsule", "reference"], &["fold"]] {
        run(&mut session.tool(words), "see its message")?;
    }
    let mut serve = session.tool(&["serve", "--listen", "127.0.0.1:0"]);
    let (_serve, said) = start(&mut serve, &["http://"])?;
    let page = said[0].trim();
    let mut motion = Ends(spawn(&mut session.tool(&["run"]))?);
    // In the middle of the run.
    thread::sleep(Duration::from_secs(9));
    for picture in OF_PAGE {
        session.takes(picture, page)?;
    }
    std::fs::write(root().join(HASH), hash_of_page())
        .map_err(|why| Failure::new(format!("{HASH}: {why}"), "is the folder writable?"))?;
    let ended = motion.0.wait().is_ok_and(|status| status.success());
    if !ended {
        return Err(Failure::new("the run did not end well", "see its message"));
    }
    let report = session.folder.join("trial.html");
    let mut tool = session.tool(&["report"]);
    tool.arg(session.folder.join("retrograde-data"))
        .arg("--out")
        .arg(&report);
    run(&mut tool, "see its message")?;
    session.takes(OF_TRIAL, &format!("file://{}", report.display()))
}

impl Session<'_> {
    fn tool(&self, words: &[&str]) -> Command {
        drop(std::fs::create_dir_all(&self.folder));
        let mut command = program("retrograde");
        command
            .args(words)
            .current_dir(&self.folder)
            .envs(self.places.clone())
            .env("RETROGRADE_RUNTIME_DIR", self.folder.join("locks"));
        command
    }

    fn takes(&self, (name, width, height, more): Picture, url: &str) -> Result<()> {
        let mut browser = Command::new(self.browser);
        browser
            .args([
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
            ])
            .args([
                "--hide-scrollbars",
                "--disable-background-networking",
                "--disable-sync",
            ])
            .arg(format!(
                "--user-data-dir={}",
                self.folder.join("browser").display()
            ))
            .arg(format!("--window-size={width},{height}"))
            .arg("--force-device-scale-factor=1")
            // Virtual time of the page, ms, for its stream to arrive.
            .arg("--virtual-time-budget=3000")
            .args(more)
            .arg(format!(
                "--screenshot={}",
                root().join("docs/pictures").join(name).display()
            ))
            .arg(url)
            .stderr(Stdio::null());
        run(&mut browser, "is it a Chromium?")
    }
}

fn program(name: &str) -> Command {
    Command::new(target().join("debug").join(name))
}

fn spawn(command: &mut Command) -> Result<Child> {
    command.stdin(Stdio::null()).spawn().map_err(|why| {
        Failure::new(
            format!("{command:?}: {why}"),
            "`cargo build --workspace --ignore-rust-version`",
        )
    })
}

/// Starts a program and reads what it says until a line has each of these parts; those lines.
fn start(command: &mut Command, parts: &[&str]) -> Result<(Ends, Vec<String>)> {
    // The bench speaks on standard error, the tool on standard output.
    let mut child = spawn(command.stdout(Stdio::piped()).stderr(Stdio::piped()))?;
    let streams: [Option<Box<dyn Read + Send>>; 2] = [
        child.stdout.take().map(|out| Box::new(out) as _),
        child.stderr.take().map(|err| Box::new(err) as _),
    ];
    let started = Ends(child);
    let (says, heard) = channel();
    for stream in streams.into_iter().flatten() {
        let says = says.clone();
        thread::spawn(move || {
            let lines = BufReader::new(stream)
                .lines()
                .map_while(std::io::Result::ok);
            // Read on after the receiver has gone, so that the program can print.
            lines.for_each(|line| drop(says.send(line)));
        });
    }
    let mut found = vec![];
    for part in parts {
        loop {
            match heard.recv_timeout(Duration::from_secs(60)) {
                Ok(line) if line.contains(part) => break found.push(line),
                Ok(_) => {}
                Err(_) => {
                    let what = format!("{command:?} does not say where it is");
                    return Err(Failure::new(what, "see its message"));
                }
            }
        }
    }
    Ok((started, found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manuals_pictures_of_the_page_are_of_this_page() {
        let kept = std::fs::read_to_string(root().join(HASH)).unwrap_or_default();
        assert!(
            kept == hash_of_page(),
            "the page has changed: `cargo xtask pictures --browser chromium` takes its pictures anew"
        );
    }
}
