//! `simulate compare`: the paper's sentences beside the model's values, with the probability that each is met.

use lab::operations::failure::Failure;
use locomotion::comparison::Sheet;
use locomotion::model::Model;
use locomotion::prior;
use report::science::model_file;
use report::science::odds::{Judged, Poll};
use report::science::posterior::Posterior;
use serde_json::{Value, json};

use crate::cli::calculation::Calculation;

pub(crate) fn compare(
    work: &mut Calculation<'_, '_>,
    model: &Model,
    posterior: Option<&Posterior>,
    bodies: u16,
) -> Result<Value, Failure> {
    let sheet = Sheet::new(model)?;
    let poll = Poll::new(model, posterior, bodies);
    let answers = work.map(&poll.questions, |question| question.answer(&sheet))?;
    let odds = poll.odds(&sheet, &answers);
    let rows: Vec<_> = sheet
        .rows
        .iter()
        .zip(&odds)
        .map(|(row, odds)| Judged::of(row, odds, posterior.is_some()))
        .collect();
    if !work.screen.json {
        let text = poll.table(&sheet, &odds);
        work.screen.print(text.as_bytes());
    }
    let origin = model_file::origin(model, posterior);
    let of_bodies = format!(
        "prior: share of the first {} of {} bodies drawn with seed {}, before any sentence is read; words: share of those of all \
         drawn that agree with the paper's words, {} on the rig, {} in the tube; in brackets 95 % of the probability (Wilson)",
        poll.bodies.prior,
        prior::DRAWS,
        prior::SEED,
        poll.bodies.rig,
        poll.bodies.tube
    );
    let of_posterior = posterior.map(|posterior| {
        format!(
            "posterior: share of {}; worth {:.0} independent ones; rows of the tube have none, since the trials do not speak \
             about its wall",
            posterior.what(),
            posterior.ess.min(posterior.samples.len() as f64)
        )
    });
    let of_posterior = of_posterior.as_deref();
    work.screen.say(&of_bodies);
    if let Some(of_posterior) = of_posterior {
        work.screen.say(of_posterior);
        work.screen.say(&origin);
    }
    let label = match of_posterior {
        Some(of_posterior) => format!("{origin}; {of_bodies}; {of_posterior}"),
        None => format!("{origin}; {of_bodies}"),
    };
    work.csv("comparison.csv", &rows, &label)?;
    let files = work.say_files();
    Ok(json!({
        "origin": origin,
        "shares": of_bodies,
        "posterior": of_posterior,
        "bodies": {
            "prior": poll.bodies.prior,
            "rig": poll.bodies.rig,
            "tube": poll.bodies.tube,
            "posterior": posterior.map(|_| poll.bodies.posterior),
        },
        "seed": prior::SEED,
        "comparison": rows,
        "files": files,
    }))
}
