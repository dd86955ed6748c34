//! `fold`: a full or a partial fold.

use client::decimal;
use lab::operations::arguments::PartialArgs;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::operations::folding::motion;
use serde_json::Value;

use crate::cli::actuation::actuate;
use crate::cli::screen::Screen;

pub(crate) fn fold(
    args: &PartialArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let motion = motion(args)?;
    if let (Some(indentation), slack) = (args.indentation_mm, args.slack_mm) {
        screen.say(&format!(
            "An indentation of {} mm is {} mm of thread by the paper's Eq. (7), with {} mm of slack.",
            decimal::write(indentation.0.into(), 3),
            decimal::fixed(motion.target_um.into(), 3),
            decimal::write(slack.0.into(), 3)
        ));
    }
    let trace = args.fold.trace.as_deref();
    actuate("fold", motion, &args.fold.record, trace, finder, screen)
}
