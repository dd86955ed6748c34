//! `design`: one origami in numbers and drawings, without a machine.

use std::path::PathBuf;

use clap::Args;
use lab::operations::failure::Failure;
use locomotion::kinematics::Design;
use report::science::design::{self, Report};
use report::science::{charts, drawing};
use serde_json::{Value, json};

use crate::cli::calculation::Named;
use crate::cli::failure;
use crate::cli::model::ModelArgs;
use crate::cli::screen::Screen;

/// Arguments of `design`. All angles are measured from the transverse axis.
#[derive(Debug, Args)]
pub struct DesignArgs {
    /// Overall width W in mm; 24.4 by default.
    #[arg(long, value_name = "MM")]
    pub width_mm: Option<f64>,
    /// Width of the core over the overall width, c/W; 0.2 by default.
    #[arg(long, value_name = "RATIO")]
    pub core_ratio: Option<f64>,
    /// Angle of the short side in degrees; 12.53 by default.
    #[arg(long, value_name = "DEG")]
    pub alpha_deg: Option<f64>,
    /// Angle of the long side in degrees; 33.69 by default.
    #[arg(long, value_name = "DEG")]
    pub beta_deg: Option<f64>,
    /// Use tan alpha = 2/9 and tan beta = 2/3; rounded to two decimals these are the paper's angles.
    #[arg(long, conflicts_with_all = ["alpha_deg", "beta_deg"])]
    pub exact_slopes: bool,
    /// Number m of crescents, 1 to 32; 9 by default.
    #[arg(long, value_name = "M", value_parser = clap::value_parser!(u8).range(1..=32))]
    pub crescents: Option<u8>,
    /// A file of parameters as `simulate` writes it, model.toml; its design applies unless an option overrides it.
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Indentation a of the drawings in mm, 0 to (W-c)/2; by default 5.05, or (W-c)/4 if the design is too narrow.
    #[arg(long, value_name = "MM")]
    pub indentation_mm: Option<f64>,
    /// Smallest alpha that the material allows, in degrees; 12.53 worked in the paper.
    #[arg(long, value_name = "DEG")]
    pub least_alpha_deg: Option<f64>,
    /// Draw the structure, unsqueezed and squeezed, to this SVG file.
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
    /// Draw the shortening over alpha and over beta to this SVG file.
    #[arg(long, value_name = "FILE")]
    pub map: Option<PathBuf>,
    /// Replace existing drawings.
    #[arg(long)]
    pub force: bool,
}

/// The requested design: options override the file, the file overrides the paper's printed design.
fn asked(args: &DesignArgs) -> Result<Design<f64>, Failure> {
    let base = match args.model {
        Some(_) => ModelArgs::of_file(args.model.clone()).model()?.design()?,
        None if args.exact_slopes => Design::paper_ratios(),
        None => Design::paper_printed(),
    };
    let width_mm = args.width_mm.unwrap_or(base.width_mm());
    let ratio = (args.core_ratio).unwrap_or(base.core_mm() / base.width_mm());
    let crescents = args.crescents.unwrap_or(base.crescents());
    let (alpha, beta) = match args.exact_slopes {
        true => (2.0 / 9.0, 2.0 / 3.0),
        false => (base.tan_alpha(), base.tan_beta()),
    };
    if args.alpha_deg.is_none() && args.beta_deg.is_none() {
        return Ok(Design::with_ratio(width_mm, ratio, alpha, beta, crescents)?);
    }
    let deg = |given: Option<f64>, tan: f64| given.unwrap_or(tan.atan().to_degrees());
    let (alpha_deg, beta_deg) = (deg(args.alpha_deg, alpha), deg(args.beta_deg, beta));
    // An invalid ratio is refused as a ratio, not as a width of the core.
    Design::with_ratio(width_mm, ratio, alpha, beta, crescents)?;
    Ok(Design::new(
        width_mm,
        ratio * width_mm,
        alpha_deg,
        beta_deg,
        crescents,
    )?)
}

pub(crate) fn design(args: &DesignArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let design = asked(args)?;
    let [drawn, map] = Named::all([args.svg.as_deref(), args.map.as_deref()], args.force)?;
    let report = design::report(&design, args.indentation_mm, args.least_alpha_deg)?;
    screen.say(&design_text(&report));
    if let Some(file) = drawn {
        let svg = drawing::structure(&design, report.indentation_mm)?;
        file.write(|out| out.write_all(svg.as_bytes()))?;
        screen.say(&format!("drawing:  {}", file.path().display()));
    }
    if let Some(file) = map {
        let svg =
            charts::maps(&design::maps(&design, args.indentation_mm)?).map_err(failure::figure)?;
        file.write(|out| out.write_all(svg.as_bytes()))?;
        screen.say(&format!("map:      {}", file.path().display()));
    }
    let shown = |path: &Option<PathBuf>| path.as_ref().map(|path| path.display().to_string());
    Ok(json!({ "design": report, "svg": shown(&args.svg), "map": shown(&args.map) }))
}

fn design_text(report: &Report) -> String {
    let Report {
        width_mm,
        core_mm,
        core_ratio,
        half_gap_mm,
        alpha_deg,
        beta_deg,
        crescents,
        long_side_mm,
        short_side_mm,
        spacing_mm,
        core_length_mm,
        length_mm,
        largest_shortening_mm,
        ..
    } = report;
    let capsule = match report.thread_to_capsule_mm {
        Some(mm) => format!("{mm:.2} mm to the width of a 13 mm capsule"),
        None => "a 13 mm capsule is out of its range".to_owned(),
    };
    let mut text = format!(
        "\
width:    W {width_mm:.3} mm, core c {core_mm:.3} mm (c/W {core_ratio:.3}), h = (W-c)/2 {half_gap_mm:.3} mm
angles:   alpha {alpha_deg:.3} deg, beta {beta_deg:.3} deg to the transverse axis
window:   alpha above {:.0} and below {:.3} deg; beta above {:.3} and below {:.0} deg
sides:    l1 {long_side_mm:.3} mm (Eq. 1), l2 {short_side_mm:.3} mm (Eq. 2)
spacing:  phi {spacing_mm:.3} mm (Eq. 3), {crescents} crescents
length:   core m phi {core_length_mm:.3} mm, overall {length_mm:.3} mm
thread:   {largest_shortening_mm:.2} mm at most, {capsule}

       a      psi       d0        d        L      W-2a  dd0/da  dd0/dalpha  dd0/dbeta
      mm       mm       mm       mm       mm        mm       1      mm/rad     mm/rad
",
        report.alpha_window_deg.0,
        report.alpha_window_deg.1,
        report.beta_window_deg.0,
        report.beta_window_deg.1,
    );
    for row in &report.squeezed {
        text += &format!(
            "{:8.3} {:8.4} {:8.4} {:8.4} {:8.4} {:9.3} {:7.4} {:11.4} {:10.4}\n",
            row.indentation_mm,
            row.spacing_mm,
            row.shortening_per_crescent_mm,
            row.shortening_mm,
            row.length_mm,
            row.width_mm,
            row.slope_by_indentation,
            // Adding zero turns -0 into 0.
            row.slope_by_alpha_mm + 0.0,
            row.slope_by_beta_mm,
        );
    }
    text += "\nthe paper's requirements (section II.A, each \"about\"):\n";
    for rule in &report.rules {
        let verdict = match rule.objection {
            None => "as the paper".to_owned(),
            Some(objection) => format!("{:+.1} %: {objection}", rule.deviation * 100.0),
        };
        text += &format!(
            "  {:<6} {:>8.3} for {:<5} {:<4} {verdict}\n",
            rule.quantity, rule.value, rule.target, rule.unit
        );
    }
    text += &match &report.best_alpha {
        Some(best) => format!(
            "best alpha: {:.3} deg, d = {:.3} mm at a = {:.2} mm: {}\n",
            best.alpha_deg, best.shortening_mm, report.indentation_mm, best.reason
        ),
        None => format!(
            "best alpha: none known for this beta: no alpha below {} deg is known to hold (`--least-alpha-deg`)\n",
            design::LEAST_ALPHA_DEG
        ),
    };
    text += &format!(
        "Eq. (6) at a = {:.2} mm: left less right side {:.3} as printed (its units do not agree), {:.3} repaired; \
         d d0/d alpha is {:.3} mm/rad. Repaired it has no root below alpha = 51.827 deg.",
        report.indentation_mm,
        report.equation_6.printed_residual,
        report.equation_6.repaired_residual,
        report.equation_6.true_derivative_mm,
    );
    text
}
