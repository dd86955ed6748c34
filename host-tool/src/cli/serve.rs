//! The command `serve`.

use serde_json::{Value, json};

use crate::cli::args::{ServeArgs, Which};
use crate::cli::failure::Failure;
use crate::cli::finding::Finder;
use crate::cli::interrupt;
use crate::cli::screen::Screen;
use crate::serve::{self, Options};

pub(crate) fn serve(
    args: &ServeArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut machines = vec![];
    for kind in finder.machines(&Which { machine: None })? {
        let address = finder.resolve(kind)?;
        if finder.connector.is_made_anew(&address) {
            return Err(Failure::Input {
                why: format!("there is no machine at `{address}` that lasts: each command makes a new one"),
                help: "`virtual-bench serve` lends both machines; give their places with `--rig tcp:HOST:PORT --capsule tcp:HOST:PORT`".to_owned(),
            });
        }
        machines.push((kind, address));
    }
    let options = Options {
        listen: args.listen,
        token_file: args.token_file.clone(),
        hosts: args.hosts.clone(),
        out: args.out.clone(),
        campaign: args.campaign.clone(),
        machines,
    };
    let pressed = interrupt::install();
    let url = serve::serve(options, finder, &pressed, &mut |text| {
        screen.tell(text);
    })?;
    Ok(json!({ "served": url }))
}
