//! `man` and `completions`: describes the command line for other programs.

use std::path::Path;

use lab::operations::failure::Failure;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn completions(
    mut command: clap::Command,
    shell: clap_complete::Shell,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut script = vec![];
    clap_complete::generate(shell, &mut command, "retrograde", &mut script);
    print(&script, "completions", screen)
}

pub(crate) fn man(
    mut command: clap::Command,
    names: &[String],
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    command.build();
    let mut page_of = &command;
    for name in names {
        page_of = page_of.find_subcommand(name).ok_or_else(|| {
            Failure::input(
                format!("there is no subcommand `{name}`"),
                "`retrograde --help` lists them",
            )
        })?;
    }
    let mut page = vec![];
    clap_mangen::Man::new(page_of.clone())
        .render(&mut page)
        .map_err(Failure::file(Path::new("man")))?;
    print(&page, "man", screen)
}

/// Prints text as the result; with `--json` it becomes a field of the object.
fn print(text: &[u8], name: &str, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    if !screen.json {
        screen.print(text);
    }
    Ok(json!({ name: String::from_utf8_lossy(text) }))
}
