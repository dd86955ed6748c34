//! The command `serve`.

mod shown;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use lab::operations::arguments::{DATA_FOLDER, Which};
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::operations::interrupt;
use serde_json::{Value, json};
use serve::Options;

use crate::cli::screen::Screen;

/// Arguments of `serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Address to listen on; port 0 takes a free one. There is no encryption: on a network, anybody who eavesdrops
    /// learns the token and can move the machines.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7080", value_parser = listen)]
    pub listen: SocketAddr,
    /// Read the token from this file, which is created if missing. Without it, each start has a new token.
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// A name by which browsers call this computer, besides `localhost` and numbers; repeat it for several.
    #[arg(long = "host", value_name = "NAME")]
    pub hosts: Vec<String>,
    /// Folder of the records.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// The campaign whose next step is shown; by default the newest one that is not complete.
    #[arg(long, value_name = "DIR")]
    pub campaign: Option<PathBuf>,
}

/// An address of this computer; a name may resolve to several.
fn listen(text: &str) -> Result<SocketAddr, String> {
    let why = "write an IP address of this computer and a port, for example 127.0.0.1:7080";
    text.parse().map_err(|_| why.to_owned())
}

pub(crate) fn serve(
    args: &ServeArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut machines = vec![];
    for kind in finder.machines(&Which { machine: None })? {
        let address = finder.resolve(kind)?;
        if finder.connector.is_created_on_open(&address) {
            return Err(Failure::input(
                format!(
                    "the machine at `{address}` does not persist: each command creates a new one"
                ),
                "`virtual-bench serve` lends both machines; give their places with `--rig tcp:HOST:PORT --capsule tcp:HOST:PORT`",
            ));
        }
        machines.push((kind, address));
    }
    let given = args.campaign.clone();
    let options = Options {
        listen: args.listen,
        token_file: args.token_file.clone(),
        hosts: args.hosts.clone(),
        out: args.out.clone(),
        campaign: Arc::new(move || {
            let folder = given.clone().or_else(shown::newest);
            folder.map(|folder| shown::json(&folder))
        }),
        machines,
    };
    let pressed = interrupt::install();
    let url = serve::serve(options, finder, &pressed, &mut |text| {
        screen.say(text);
    })?;
    Ok(json!({ "served": url }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct TestArgs {
        #[command(flatten)]
        args: ServeArgs,
    }

    #[test]
    fn a_name_is_no_address_to_listen_at() {
        let line = |listen: &str| TestArgs::try_parse_from(["serve", "--listen", listen]);
        for wrong in [
            "localhost:7080",
            "lab-pc:7080",
            "127.0.0.1",
            ":7080",
            "127.0.0.1:70800",
        ] {
            let why = line(wrong).expect_err(wrong).to_string();
            assert!(why.contains("for example 127.0.0.1:7080"), "{why}");
        }
        for good in ["192.168.1.20:7080", "[::1]:0"] {
            assert_eq!(line(good).expect(good).args.listen.to_string(), good);
        }
    }
}
