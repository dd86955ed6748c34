//! Targets of `fold`: the end, a length of thread, or the indentation that would fold as far.

use crate::trials::experiment::Actuation;
use client::decimal;
use locomotion::kinematics::Design;
use protocol::capsule::ActuationKind;

use crate::operations::arguments::PartialArgs;
use crate::operations::failure::Failure;

/// Converts the arguments to a motion of the capsule.
pub fn motion(args: &PartialArgs) -> Result<Actuation, Failure> {
    Ok(match (args.thread_mm, args.indentation_mm) {
        (Some(thread), _) => Actuation::fold_to(target_um(thread.0.into())?),
        (None, Some(indentation)) => {
            Actuation::fold_to(thread_um(indentation.0.into(), args.slack_mm.0.into())?)
        }
        (None, None) => ActuationKind::Fold.into(),
    })
}

fn target_um(thread_um: u64) -> Result<i32, Failure> {
    i32::try_from(thread_um).map_err(|_| {
        Failure::input(
            format!("{} mm of thread is too much", decimal::write(thread_um, 3)),
            "nothing was sent; the calibrated end is at some 22 mm",
        )
    })
}

/// Length of thread on the spool at which the paper's origami is as short as this indentation would make it.
fn thread_um(indentation_um: u64, slack_um: u64) -> Result<i32, Failure> {
    let design = Design::paper_printed();
    // `f64` is exact enough for lengths of some millimetres.
    let indentation_mm = indentation_um as f64 / 1e3;
    let shortening_mm = design
        .shortening_mm(indentation_mm)
        .map_err(|why| Failure::input(why.to_string(), "nothing was sent"))?;
    target_um(slack_um.saturating_add((shortening_mm * 1e3).round() as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 21 mm of thread fold to 14.3 mm of width: an indentation of 5.05 mm (the paper, section III).
    #[test]
    fn an_indentation_is_the_thread_of_equation_7() {
        let design = Design::paper_printed();
        for indentation_um in [500, 2_000, 5_050] {
            let Ok(thread) = thread_um(indentation_um, 1_000) else {
                panic!("{indentation_um} um is refused");
            };
            let travel_mm = f64::from(thread - 1_000) / 1e3;
            let back = design.indentation_for_thread_mm(travel_mm).expect("travel");
            assert!((back * 1e3 - indentation_um as f64).abs() < 1.0);
        }
        assert!(thread_um(100_000, 0).is_err());
    }
}
