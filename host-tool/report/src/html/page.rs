//! The page around a report: style for light and dark, phone and print, and the banner on the origin of the data.

use client::identity::Origin;
use client::visible;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::figures::palette;

/// Style of the page; [`palette::dark_style`] has the colours of its drawings.
const STYLE: &str = "\
:root{color-scheme:light;--ink:#222;--soft:#555;--line:#ddd;--page:#fff;--ok:#176b2c;--bad:#a51d1d;--link:#1f5aa8;--alarm:#a51d1d}\
@media screen and (prefers-color-scheme:dark){:root{color-scheme:dark;--ink:#e6e6e6;--soft:#a9adb5;--line:#3a3e45;--page:#15171a;\
--ok:#6fd38a;--bad:#ff8f8a;--link:#8db9f5;--alarm:#8e1b1b}}\
*{box-sizing:border-box}\
body{font:15px/1.45 system-ui,sans-serif;color:var(--ink);background:var(--page);max-width:66rem;margin:1.5rem auto 4rem;padding:0 1rem;overflow-wrap:anywhere}\
h1{font-size:1.6rem;margin:.6rem 0}h2{font-size:1.2rem;margin:2.4rem 0 .4rem;border-top:1px solid var(--line);padding-top:1.2rem}\
h3{font-size:1rem;margin:1.2rem 0 .3rem}a{color:var(--link)}\
.wide{overflow-x:auto;margin:.4rem 0 1rem}table{border-collapse:collapse;width:100%}\
th,td{border-bottom:1px solid var(--line);padding:.22rem .8rem .22rem 0;text-align:left;vertical-align:top;font-variant-numeric:tabular-nums;overflow-wrap:normal}\
.short table{width:auto}.short th{padding-right:2rem}td.n,th.n{text-align:right}td.n{white-space:nowrap}td.hash{overflow-wrap:anywhere}\
th{font-weight:600;color:var(--soft)}figure{margin:.6rem 0;display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,27rem),1fr));gap:.6rem 1.2rem}\
figure.one{max-width:36rem;grid-template-columns:1fr}figure.both{display:block}\
@media (min-width:50rem){.both svg:first-child{display:none}}@media (max-width:49.99rem){.both svg+svg{display:none}}\
.within{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);column-gap:1.4rem;align-items:start}\
.trial{border-top:1px solid var(--line)}summary{cursor:pointer;padding:.5rem 0;font-weight:600}.within>.bad{grid-column:1/-1}figcaption{color:var(--soft);font-size:.9rem;grid-column:1/-1}svg{width:100%;height:auto;display:block}\
.ok{color:var(--ok)}.bad{color:var(--bad);font-weight:600}ul.bad{font-weight:400;padding-left:1.2rem;margin:.3rem 0}\
.banner{background:var(--alarm);color:#fff;padding:.7rem 1rem;border-radius:.4rem;font-weight:600;font-size:1.05rem}\
.tag{font-size:.8rem;font-weight:600;border:1px solid var(--bad);color:var(--bad);border-radius:.3rem;padding:.05rem .4rem;white-space:nowrap}\
code{font-size:.92em}.hash{font-family:ui-monospace,monospace;font-size:.8rem;overflow-wrap:anywhere}\
@media (max-width:36rem){body{font-size:14px;padding:0 1rem}.wide table{font-size:12.5px}th,td{padding-right:.4rem}.within{grid-template-columns:minmax(0,1fr)}}\
@media print{@page{margin:14mm}body{max-width:none;margin:0;padding:0;font-size:10pt}h1,h2,h3{break-after:avoid;break-inside:avoid}\
figure,tr,.banner,li,.trial{break-inside:avoid}.trial{font-size:8.5pt}.within{grid-template-columns:60mm minmax(0,1fr)}details:not([open]){display:none}\
thead{display:table-header-group}.wide{overflow:visible}.short{break-inside:avoid}\
.banner{-webkit-print-color-adjust:exact;print-color-adjust:exact}a{color:inherit;text-decoration:none}\
section>p,section>ul{break-after:avoid}figure{grid-template-columns:minmax(0,1fr) minmax(0,1fr)}figure.one{grid-template-columns:1fr;max-width:150mm}.both{max-width:170mm}}";

/// A complete page that loads nothing, and in which no foreign text can change the direction of writing.
pub(crate) fn page(title: &str, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style {
                    (PreEscaped(STYLE))
                    "@media screen and (prefers-color-scheme:dark){" (PreEscaped(palette::dark_style())) "}"
                }
            }
            body { (body) }
        }
    };
    visible::html(&page.into_string()).into_owned()
}

/// The banner on the origins of everything on the page; empty if all of it is measured.
pub(crate) fn banner(origins: &[Origin]) -> Markup {
    let count = |wanted: Origin| origins.iter().filter(|origin| **origin == wanted).count();
    let (simulated, unknown) = (count(Origin::Virtual), count(Origin::Unknown));
    let of = |number: usize| match origins.len() {
        all if all == number => "all trials".to_owned(),
        all => format!("{number} of {all} trials"),
    };
    html! {
        @if simulated > 0 {
            p.banner { "VIRTUAL: " (of(simulated)) " on this page were simulated. They are not measurements." }
        }
        @if unknown > 0 {
            p.banner { "ORIGIN UNKNOWN: the records of " (of(unknown)) " on this page do not say whether a machine or a simulation made them." }
        }
    }
}

/// A tag for a heading; empty for a measurement.
pub(crate) fn tag(origin: Origin) -> Markup {
    html! {
        @match origin {
            Origin::Board => {},
            Origin::Virtual => { " " span.tag { "virtual" } },
            Origin::Unknown => { " " span.tag { "origin unknown" } },
        }
    }
}

pub(crate) fn rows<'a>(rows: impl IntoIterator<Item = (&'a str, String)>) -> Markup {
    html! {
        div.wide.short { table { tbody {
            @for (name, value) in rows { tr { th { (name) } td { (value) } } }
        } } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_character_turns_a_page_around() {
        let page = page(
            "rig \u{202e}gpj",
            &html! { p { "a note\u{2066}\u{7} <b>" } },
        );
        assert!(
            page.contains("<title>rig &lt;U+202E&gt;gpj</title>"),
            "{page}"
        );
        assert!(
            page.contains("<p>a note&lt;U+2066&gt;&lt;U+0007&gt; &lt;b&gt;</p>"),
            "{page}"
        );
    }

    #[test]
    fn a_banner_is_there_for_everything_that_is_no_measurement() {
        let text = |origins: &[Origin]| banner(origins).into_string();
        assert_eq!(text(&[Origin::Board, Origin::Board]), "");
        let one = text(&[Origin::Board, Origin::Virtual]);
        assert!(one.contains("VIRTUAL: 1 of 2 trials"), "{one}");
        let all = text(&[Origin::Virtual, Origin::Virtual]);
        assert!(all.contains("VIRTUAL: all trials"), "{all}");
        let unknown = text(&[Origin::Unknown]);
        assert!(unknown.contains("ORIGIN UNKNOWN"), "{unknown}");
    }
}
