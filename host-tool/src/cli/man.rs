//! `man` and `completions`: describes the command line for other programs.

use operations::failure::Failure;
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
        page_of = page_of
            .find_subcommand(name)
            .ok_or_else(|| Failure::Input {
                why: format!("there is no subcommand `{name}`"),
                help: "`retrograde --help` lists them".to_owned(),
            })?;
    }
    let mut page = vec![];
    let failed = |io| Failure::File {
        path: "man".into(),
        io,
    };
    clap_mangen::Man::new(page_of.clone())
        .render(&mut page)
        .map_err(failed)?;
    print(&page, "man", screen)
}

/// Prints text as the result; with `--json` it becomes a field of the object.
fn print(text: &[u8], name: &str, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    if !screen.json {
        screen.print(text);
    }
    Ok(json!({ name: String::from_utf8_lossy(text) }))
}
